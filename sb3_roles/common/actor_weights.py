"""The weights that a policy needs to act: those of its actors, without the critics."""

from __future__ import annotations

import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_roles.common.checkpoint import Checkpoint, CheckpointError
from sb3_roles.common.checkpoint_fit import check_weights
from sb3_roles.common.checkpoint_reading import Outline
from sb3_roles.common.policies import TeamPolicy

HOLDS, ACTORS = "holds", "actors"
"""Key of a checkpoint's manifest, and its value in a file without critics."""
STORED_AS = {"float32": th.float32, "float16": th.float16}
"""How such a file may store weights."""


def actor_weights(policy: BasePolicy) -> dict[str, th.Tensor]:
    """Return the weights and buffers that decide how a policy acts.

    Of a :class:`~sb3_roles.common.policies.TeamPolicy` these are all but those of its critics,
    whose modules have "value" in their name. Of any other policy they are all: what its modules
    are for is not known.

    :param policy: any policy
    :return: name -> tensor, those of the policy itself
    """
    weights = policy.state_dict()
    if not isinstance(policy, TeamPolicy):
        return weights
    return {name: tensor for name, tensor in weights.items() if "value" not in name}


def stored(weights: dict[str, th.Tensor], dtype: str) -> dict[str, th.Tensor]:
    """Return weights as a file shall hold them.

    :param weights: name -> tensor
    :param dtype: of ``STORED_AS``, for those that are float32
    :raises CheckpointError: naming a weight that is not finite, or too large for this type
    """
    kept = {}
    for name, tensor in weights.items():
        kept[name] = tensor.to(STORED_AS[dtype]) if tensor.dtype == th.float32 else tensor
        if kept[name].is_floating_point() and not bool(th.isfinite(kept[name]).all()):
            raise CheckpointError(f"weights {name}: a number of them is none in {dtype}")
    return kept


def load_actors(policy: BasePolicy, checkpoint: Checkpoint) -> None:
    """Put the weights of the actors into a policy; its critics stay as they are.

    :param policy: built from the configuration
    :param checkpoint: whose manifest says that it ``HOLDS`` the ``ACTORS``; float16 becomes the
        policy's own type
    :raises CheckpointError: if a name, shape or dtype is another one; nothing is changed then
    """
    given = _check(actor_weights(policy), checkpoint)
    policy.load_state_dict({**policy.state_dict(), **given})


def check_policy(policy: BasePolicy, found: Checkpoint | Outline) -> None:
    """Refuse weights that are not those of a policy, or of its actors where there are only those.

    :param policy: built from the configuration; may be without memory
    :param found: what a file holds, or declares
    :raises CheckpointError: if a name, shape or dtype is another one
    """
    if found.manifest.get(HOLDS) == ACTORS:
        _check(actor_weights(policy), found)
    else:
        check_weights(found.policy, policy.state_dict())


def _check(own: dict[str, th.Tensor], found: Checkpoint | Outline) -> dict[str, th.Tensor]:
    given = {
        name: tensor.float() if tensor.dtype == th.float16 else tensor
        for name, tensor in found.policy.items()
    }
    check_weights(given, own, owner="actors of the configuration")
    return given
