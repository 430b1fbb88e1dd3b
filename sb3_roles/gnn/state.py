"""What a checkpoint keeps of behavior cloning, checked before any of it is used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch as th

from sb3_roles.common.checkpoint import CheckpointError
from sb3_roles.common.names import one_line
from sb3_roles.common.snapshot import check_weights


@dataclass
class CloningState:
    """How far cloning is, and what it found.

    :param epochs: over the demonstrations
    :param best_epoch: the one with the lowest validation loss; 0 for none
    :param best_loss: that loss, nats
    :param best_weights: of the policy then; empty for none
    """

    epochs: int = 0
    best_epoch: int = 0
    best_loss: float = float("inf")
    best_weights: Mapping[str, th.Tensor] = field(default_factory=dict)


def plain_state(state: CloningState, facts: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a checkpoint keeps.

    :param state: of now
    :param facts: of the demonstrations, see ``source.describe``; empty if none were looked at
    """
    return {
        "epochs": state.epochs,
        "best_epoch": state.best_epoch,
        "best_loss": state.best_loss,
        "best_weights": {name: value.cpu().numpy() for name, value in state.best_weights.items()},
        "demonstrations": dict(facts),
    }


def read_state(
    saved: Mapping[str, Any], own: Mapping[str, th.Tensor]
) -> tuple[CloningState, Mapping[str, Any]]:
    """Read what :func:`plain_state` returned.

    :param saved: of a file, which may say anything
    :param own: the policy's weights by name
    :return: the state, on the device of ``own``, and the facts of the demonstrations
    :raises CheckpointError: if it is damaged, or does not fit the policy
    """
    try:
        epochs, best_epoch = int(saved["epochs"]), int(saved["best_epoch"])
        best_loss, facts = float(saved["best_loss"]), dict(saved["demonstrations"])
        weights = {
            name: th.from_numpy(np.array(value)) for name, value in saved["best_weights"].items()
        }
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
        raise CheckpointError(f"damaged state of the cloning: {one_line(error)}") from error
    if not 0 <= best_epoch <= epochs or bool(weights) != (best_epoch > 0):
        raise CheckpointError(
            f"damaged state of the cloning: best epoch {best_epoch} of {epochs}, and "
            f"{len(weights)} best weights"
        )
    if weights:
        check_weights(weights, own, "best weights", "policy")
        weights = {name: given.to(own[name].device) for name, given in weights.items()}
    return CloningState(epochs, best_epoch, best_loss, weights), facts


def check_same_demonstrations(before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Refuse to go on with other demonstrations; where their file is does not matter.

    :param before: facts of a checkpoint
    :param now: facts of what was read
    :raises CheckpointError: saying what changed; the hash is named where nothing else did
    """
    if before.get("sha256") == now["sha256"]:
        return
    keys = [key for key in now if key not in ("file", "sha256") and before.get(key) != now[key]]
    changes = [f"{k} was {before.get(k)!r}, is {now[k]!r}" for k in keys or ["sha256"]]
    raise CheckpointError(
        f"the demonstrations are others than those of the run: {'; '.join(changes)}"
    )
