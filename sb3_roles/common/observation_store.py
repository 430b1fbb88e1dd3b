"""The observations of a rollout, one key each: maps of 0 and 1 take a bit for each cell."""

from __future__ import annotations

import numpy as np
import torch as th
from gymnasium import spaces


def take_groups(memory: th.Tensor, index: th.Tensor, size: int) -> th.Tensor:
    """Gather groups of consecutive rows.

    :param memory: (T, n, ...), contiguous
    :param index: int64 (b,), numbers of groups
    :param size: rows in a group
    :return: (b * size, ...)
    """
    # Whole groups as one row each: several times faster than advanced indexing of many dimensions.
    groups = memory.view(memory.shape[0] * memory.shape[1] // size, -1)
    return groups.index_select(0, index).view(-1, *memory.shape[2:])


def pack_bits(rows: th.Tensor) -> th.Tensor:
    """Pack eight flags in a byte, the first one in its highest bit.

    :param rows: uint8 (n, m), 0 or 1
    :return: uint8 (n, ceil(m / 8))
    """
    if rows.device.type == "cpu":
        return th.from_numpy(np.packbits(rows.numpy(), axis=1))
    return pack_by_shifts(rows)


def unpack_bits(packed: th.Tensor, count: int) -> th.Tensor:
    """Undo :func:`pack_bits`.

    :param packed: uint8 (n, ceil(count / 8))
    :param count: flags in a row
    :return: uint8 (n, count), 0 or 1
    """
    if packed.device.type == "cpu":
        return th.from_numpy(np.unpackbits(packed.numpy(), axis=1, count=count))
    return unpack_by_shifts(packed, count)


def pack_by_shifts(rows: th.Tensor) -> th.Tensor:
    """Do what :func:`pack_bits` does, on any device."""
    padded = th.nn.functional.pad(rows, (0, -rows.shape[1] % 8)).unflatten(1, (-1, 8))
    return (padded << _shifts(rows.device)).sum(2, dtype=th.uint8)


def unpack_by_shifts(packed: th.Tensor, count: int) -> th.Tensor:
    """Do what :func:`unpack_bits` does, on any device."""
    flags = (packed.unsqueeze(2) >> _shifts(packed.device)) & 1
    return flags.flatten(1)[:, :count]


def _shifts(device: th.device) -> th.Tensor:
    return th.arange(7, -1, -1, dtype=th.uint8, device=device)


def is_binary(space: spaces.Space) -> bool:
    """Whether the values of a space are bytes that are 0 or 1."""
    return (
        isinstance(space, spaces.Box) and space.dtype == np.uint8 and bool((space.high <= 1).all())
    )


class ObservationStore:
    """The values of one key over time; maps are laid out with their channels last in memory.

    :param buffer_size: steps
    :param sample: of one step, (n, ...)
    :param space: of one row
    """

    def __init__(self, buffer_size: int, sample: th.Tensor, space: spaces.Space) -> None:
        self._is_map = sample.ndim == 4
        inner = self._inner(sample)
        self._shape = inner.shape[1:]
        # Faster, too: less is gathered.
        self._packed = is_binary(space) and sample.dtype == th.uint8
        shape = (-(-self._shape.numel() // 8),) if self._packed else self._shape
        self.memory = th.zeros(
            (buffer_size, len(sample), *shape), dtype=sample.dtype, device=sample.device
        )

    def _inner(self, value: th.Tensor) -> th.Tensor:
        return value.permute(0, 2, 3, 1) if self._is_map else value

    def put(self, t: int, value: th.Tensor) -> None:
        """Store the values of one step, (n, ...)."""
        inner = self._inner(value)
        self.memory[t].copy_(pack_bits(inner.reshape(len(inner), -1)) if self._packed else inner)

    def take(self, index: th.Tensor, n_teams: int) -> th.Tensor:
        """Gather (time, team) pairs.

        :param index: int64 (b,), time * n_teams + team
        :param n_teams: number of teams
        :return: (b * rows of this key per team, ...)
        """
        taken = take_groups(self.memory, index, self.memory.shape[1] // n_teams)
        if self._packed:
            taken = unpack_bits(taken, self._shape.numel()).view(-1, *self._shape)
        return taken.permute(0, 3, 1, 2) if self._is_map else taken
