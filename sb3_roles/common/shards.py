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
