"""Numbers that are not finite: found before any weight changes, named, and kept to be looked at."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch as th

from sb3_roles.common.files import write_atomically

NOT_FINITE_FILE = "not_finite.safetensors"
MOST_BYTES = 64 << 20
"""Of a file of :func:`dump`; of larger minibatches the first rows are kept."""


# A ValueError as what is wrong with an environment, a FloatingPointError as what training meets.
class NotFiniteError(FloatingPointError, ValueError):
    """A NaN or an infinity in what is learned from; nothing was learned from it.

    :param part: ``observation``, ``reward``, ``return``, ``advantage``, ``loss`` or ``gradient``
    :param message: one line: what, where, and what may help
    :param tensors: what it was found in, by name
    """

    def __init__(
        self, part: str, message: str, tensors: Mapping[str, th.Tensor | np.ndarray] | None = None
    ) -> None:
        super().__init__(message)
        self.part = part
        self.tensors = dict(tensors or {})

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.part, str(self), self.tensors)

    def found_in(self, where: str, tensors: Mapping[str, th.Tensor | np.ndarray]) -> NotFiniteError:
        """Return the error with the minibatch that it was found in.

        :param where: which one
        :param tensors: the minibatch, rows first
        """
        return NotFiniteError(self.part, f"{self} ({where})", {**self.tensors, **tensors})


def dump(path: Path, error: NotFiniteError) -> bool:
    """Write what the numbers were found in, atomically.

    :param path: of a safetensors file; its metadata say what it is
    :param error: which was raised
    :return: False if there is nothing to write
    :raises OSError: if the disk refuses
    """
    tensors = {
        name: (th.from_numpy(np.array(one)) if isinstance(one, np.ndarray) else one).detach()
        for name, one in error.tensors.items()
    }
    if not tensors:
        return False
    total = sum(tensor.nbytes for tensor in tensors.values())
    share = min(1.0, MOST_BYTES / max(1, total))
    kept = {
        name: tensor[: max(1, int(share * len(tensor)))] if tensor.ndim else tensor
        for name, tensor in tensors.items()
    }
    about = {
        "what": str(error),
        "part": error.part,
        "rows": "all" if share == 1.0 else f"the first {share:.2%} of each tensor",
    }
    # Clones: safetensors refuses tensors that share memory.
    copies = {name: one.to("cpu", copy=True).contiguous() for name, one in kept.items()}
    write_atomically(path, safetensors.torch.save(copies, about))
    return True


def check_loss(loss: th.Tensor) -> None:
    """Refuse a loss that is not finite.

    :param loss: float ()
    :raises NotFiniteError: if it is NaN or infinite
    """
    if not th.isfinite(loss):
        raise NotFiniteError(
            "loss",
            f"the loss is {loss.item()}: no step was taken; check rewards and observations, or "
            "lower learning_rate",
        )


def gradient_error(policy: th.nn.Module) -> NotFiniteError:
    """Return the error of gradients that are not finite.

    :param policy: whose parameters have them
    """
    where = next(
        (
            f"the gradient of {name} has a NaN or an infinity"
            for name, parameter in policy.named_parameters()
            if parameter.grad is not None and not bool(th.isfinite(parameter.grad).all())
        ),
        "the norm of the gradients overflows",
    )
    return NotFiniteError(
        "gradient",
        f"{where}: no step was taken; lower learning_rate, or try precision='fp32'",
    )


def guard_optimizer(policy: Any) -> None:
    """Let the optimizer of an algorithm that does not look refuse gradients that are not finite.

    :param policy: of Stable-Baselines3
    """

    def look(*_: Any) -> None:
        sums = [one.grad.sum() for one in policy.parameters() if one.grad is not None]
        if sums and not th.isfinite(th.stack(sums).sum()):
            raise gradient_error(policy)

    policy.optimizer.register_step_pre_hook(look)
