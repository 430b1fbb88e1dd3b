"""Work on parts side by side, on the threads of a CPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from types import TracebackType
from typing import TypeVar

import torch as th

Part = TypeVar("Part")
Result = TypeVar("Result")


class ThreadCrew:
    """Lets each part of some work be done by a thread of its own.

    Networks of this size are too small for the threads inside of operations: starting and joining
    them for each one costs what they gain. PyTorch lets other threads run while it computes, so
    that whole passes can go side by side.

    What is computed may depend on the parts, by rounding, and not on the threads: with one thread
    the parts follow each other. A context manager, within which operations have the given threads,
    in this thread and in those of the crew.

    :param n_parts: parts at most that are worked on at once
    :param device: on a GPU the parts follow each other
    :param inside: threads inside of an operation; None for an equal share of torch's
    """

    def __init__(self, n_parts: int, device: th.device, inside: int | None = None) -> None:
        self._threads = th.get_num_threads()
        on_cpu = device.type == "cpu"
        self._n_workers = min(n_parts, self._threads) if on_cpu else 1
        self._inside = self._threads // self._n_workers if inside is None else inside
        self._pool: ThreadPoolExecutor | None = None

    def __enter__(self) -> ThreadCrew:
        if self._inside != self._threads:
            th.set_num_threads(self._inside)
        if self._n_workers > 1:
            # The setting is one of each thread.
            self._pool = ThreadPoolExecutor(
                self._n_workers, "crew", th.set_num_threads, (self._inside,)
            )
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
        if self._inside != self._threads:
            th.set_num_threads(self._threads)

    def map(self, work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
        """Work on some parts.

        :param work: gets one part; torch's modes, such as ``inference_mode``, are those of each
            thread and must be entered inside
        :param parts: as many as there are
        :return: in the order of the parts
        """
        if self._pool is None or len(parts) == 1:
            return [work(part) for part in parts]
        return list(self._pool.map(work, parts))
