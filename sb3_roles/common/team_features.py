"""Features of whole teams, of which the robots share some: first layers compute those once."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch import nn
from torch.nn import functional as F


class TeamFeatures:
    """Features of rows, side by side; what a team shares is kept once per team.

    A layer on the concatenation is a sum of products with parts of its weights. The shared part of
    the sum is computed once per team, and no concatenation of all rows is written.

    :param n_rows: number of rows, those of a team next to each other
    :param parts: float (n_rows, any) each, or (n_teams, any) for what a team shares
    """

    def __init__(self, n_rows: int, parts: Sequence[th.Tensor]) -> None:
        self.n_rows = n_rows
        self._parts = list(parts)
        self._joined: tuple[th.Tensor | None, th.Tensor | None] | None = None

    def joined(self, part: th.Tensor) -> TeamFeatures:
        """Return these features with more of them at the end, float (n_rows, any)."""
        return TeamFeatures(self.n_rows, [*self._parts, part])

    @property
    def size(self) -> int:
        """Number of features of a row."""
        return sum(part.shape[1] for part in self._parts)

    def rows(self) -> th.Tensor:
        """Return the concatenation, float (n_rows, size)."""
        n = self.n_rows
        spread = [part.repeat_interleave(n // len(part), dim=0) for part in self._parts]
        return th.cat(spread, dim=1)

    def _own(self, part: th.Tensor) -> bool:
        return part.shape[0] == self.n_rows

    def _join(self) -> tuple[th.Tensor | None, th.Tensor | None]:
        """Concatenate what rows have of their own, and what they share."""
        if self._joined is None:
            groups = [
                [part for part in self._parts if self._own(part) is own] for own in (True, False)
            ]
            own, shared = (th.cat(group, dim=1) if group else None for group in groups)
            self._joined = own, shared
        return self._joined

    def linear(self, layer: nn.Linear) -> th.Tensor:
        """Apply a layer to the concatenation.

        :param layer: ``in_features`` is ``size``
        :return: float (n_rows, out_features)
        """
        own, shared = self._join()
        if shared is None:
            return layer(own)
        columns = layer.weight.split([part.shape[1] for part in self._parts], dim=1)
        by_owner: dict[bool, list[th.Tensor]] = {True: [], False: []}
        for part, weight in zip(self._parts, columns, strict=True):
            by_owner[self._own(part)].append(weight)
        of_team = F.linear(shared, th.cat(by_owner[False], dim=1), layer.bias)
        if own is None:
            return of_team.repeat_interleave(self.n_rows // len(of_team), dim=0)
        of_rows = F.linear(own, th.cat(by_owner[True], dim=1))
        teams = of_rows.view(len(of_team), -1, of_rows.shape[1])
        return (teams + of_team.unsqueeze(1)).flatten(0, 1)


def apply_linear(layer: nn.Linear, x: th.Tensor | TeamFeatures) -> th.Tensor:
    """Apply a layer to rows, or to what stands for them."""
    return x.linear(layer) if isinstance(x, TeamFeatures) else layer(x)
