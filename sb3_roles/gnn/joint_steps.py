"""Demonstrations as a data set of PyTorch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch as th
from torch.utils.data import DataLoader, Dataset

from sb3_roles.gnn.demonstrations import Demonstrations

Batch = tuple[dict[str, th.Tensor], th.Tensor]


class JointSteps(Dataset):
    """The steps of some episodes, as a data set of PyTorch; one item is one step of the team.

    :param demonstrations: the episodes
    :param rows: which of them
    """

    def __init__(self, demonstrations: Demonstrations, rows: Sequence[int] | np.ndarray) -> None:
        self.demonstrations = demonstrations
        self.rows = np.asarray(rows, np.int64)

    def __len__(self) -> int:
        return len(self.rows) * self.demonstrations.n_steps

    def __getitem__(self, index: int) -> Batch:
        """Return one step, see :meth:`__getitems__`."""
        return self.__getitems__([index])

    def __getitems__(self, indices: Sequence[int]) -> Batch:
        """Return some steps at once, which is what a ``DataLoader`` asks for.

        :param indices: of b items
        :return: observations of b teams by key, and actions int64 (b N,)
        """
        order, steps = np.divmod(np.asarray(indices, np.int64), self.demonstrations.n_steps)
        episodes = self.rows[order]
        observed = self.demonstrations.observe(episodes, steps)
        actions = self.demonstrations.actions[episodes, steps].reshape(-1).astype(np.int64)
        return {key: th.from_numpy(array) for key, array in observed.items()}, th.from_numpy(
            actions
        )


def batches(
    steps: JointSteps, batch_size: int, device: th.device, generator: th.Generator | None = None
) -> Iterator[Batch]:
    """Go through some steps once.

    :param steps: all of them
    :param batch_size: joint steps of a batch; the last one may be smaller
    :param device: where the batches shall be
    :param generator: shuffles; None keeps the order
    :return: see :meth:`JointSteps.__getitems__`
    """
    loader = DataLoader(
        steps,
        batch_size,
        shuffle=generator is not None,
        generator=generator,
        collate_fn=lambda batch: batch,
    )
    for observations, actions in loader:
        yield moved(observations, actions, device)


def moved(observations: Mapping[str, th.Tensor], actions: th.Tensor, device: th.device) -> Batch:
    """Return a batch on another device."""
    return {key: value.to(device) for key, value in observations.items()}, actions.to(device)
