"""Gradients of the parts of a minibatch, computed side by side on the threads of a CPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TypeVar

import torch as th

Result = TypeVar("Result")
Gradients = Sequence[th.Tensor | None]
"""One for each parameter; None for one that the loss does not depend on."""


class Shards:
    """Splits minibatches, and lets each part be worked on by a thread of its own.

    Networks of this size are too small for the threads inside of operations: starting and joining
    them for each one costs what they gain. PyTorch lets other threads run while it computes, so
    that whole passes can go side by side.

    What is computed depends on the number of shards, by rounding, and not on the threads: with
    one thread the shards follow each other. A context manager, within which the operations of
    each shard have an equal share of torch's threads.

    :param n_shards: parts of a minibatch
    :param device: on a GPU the shards follow each other
    """

    def __init__(self, n_shards: int, device: th.device) -> None:
        self.n_shards = n_shards
        self._threads = th.get_num_threads()
        on_cpu = device.type == "cpu"
        self._n_workers = min(n_shards, self._threads) if on_cpu else 1
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> Shards:
        if self._n_workers > 1:
            each = self._threads // self._n_workers
            th.set_num_threads(each)
            # The setting is one of each thread.
            self._pool = ThreadPoolExecutor(self._n_workers, "shard", th.set_num_threads, (each,))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)
            self._pool = None
            th.set_num_threads(self._threads)

    def map(self, work: Callable[[th.Tensor], Result], index: th.Tensor) -> list[Result]:
        """Work on the shards of a minibatch.

        :param work: gets the pairs of one shard
        :param index: int64 (b,), all pairs
        :return: in the order of the shards; fewer than ``n_shards`` if there are fewer pairs
        """
        parts = [part for part in index.tensor_split(self.n_shards) if len(part)]
        if self._pool is None:
            return [work(part) for part in parts]
        return list(self._pool.map(work, parts))


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
