"""Shards: parts of a minibatch, whose gradients are computed side by side and added."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th

Gradients = Sequence[th.Tensor | None]
"""One for each parameter; None for one that the loss does not depend on."""


def shards_of(index: th.Tensor, n_shards: int) -> list[th.Tensor]:
    """Divide a minibatch.

    :param index: int64 (b,), all pairs
    :param n_shards: parts at most; there is no empty one
    """
    return [part for part in index.tensor_split(n_shards) if len(part)]


def add_gradients(parts: Sequence[Gradients]) -> list[th.Tensor | None]:
    """Add gradients in their order.

    :param parts: at least one
    """
    total = list(parts[0])
    for part in parts[1:]:
        for k, gradient in enumerate(part):
            if gradient is not None:
                before = total[k]
                total[k] = gradient if before is None else before.add_(gradient)
    return total


def trainable(module: th.nn.Module) -> list[th.nn.Parameter]:
    """Return the parameters that are not frozen."""
    return [parameter for parameter in module.parameters() if parameter.requires_grad]


def set_gradients(parameters: Sequence[th.nn.Parameter], gradients: Gradients) -> None:
    """Give each parameter its gradient, in the memory layout of the parameter.

    Convolutions return theirs in another one, and a fused optimizer goes through both by address.
    """
    for parameter, gradient in zip(parameters, gradients, strict=True):
        if gradient is not None and gradient.stride() != parameter.stride():
            gradient = th.empty_like(parameter, requires_grad=False).copy_(gradient)
        parameter.grad = gradient
