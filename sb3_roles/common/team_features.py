"""Features of whole teams, of which the robots share some: first layers compute those once."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
from torch import nn
from torch.nn import functional as F


class TeamFeatures:
    """Features of rows, side by side; what a team shares is kept once per team.

    A layer on the concatenation is a sum of products with parts of its weights. What the team
    shares, if it stands at the end, is multiplied once per team, and never written for each row.

    :param n_rows: number of rows, those of a team next to each other
    :param parts: float (n_rows, any) each, or (n_teams, any) for what a team shares
    """

    def __init__(self, n_rows: int, parts: Sequence[th.Tensor]) -> None:
        self.n_rows = n_rows
        self._parts = list(parts)
        self._joined: tuple[th.Tensor | None, th.Tensor | None] | None = None

    def joined(self, part: th.Tensor) -> TeamFeatures:
        """Return these features with more of them in front, float (n_rows, any)."""
        return TeamFeatures(self.n_rows, [part, *self._parts])

    def rows(self) -> th.Tensor:
        """Return the concatenation, float (n_rows, size)."""
        return th.cat([self._spread(part) for part in self._parts], dim=1)

    def _spread(self, part: th.Tensor) -> th.Tensor:
        return part.repeat_interleave(self.n_rows // len(part), dim=0)

    def _join(self) -> tuple[th.Tensor | None, th.Tensor | None]:
        """Concatenate what rows have of their own, and what they share at the end."""
        if self._joined is None:
            first = len(self._parts)
            while first and len(self._parts[first - 1]) != self.n_rows:
                first -= 1
            own = [self._spread(part) for part in self._parts[:first]]
            shared = self._parts[first:]
            self._joined = (
                th.cat(own, dim=1) if own else None,
                th.cat(shared, dim=1) if shared else None,
            )
        return self._joined

    def linear(self, layer: nn.Linear) -> th.Tensor:
        """Apply a layer to the concatenation.

        :param layer: its ``in_features`` are the features of a row
        :return: float (n_rows, out_features)
        """
        own, shared = self._join()
        if shared is None:
            return layer(own)
        width = 0 if own is None else own.shape[1]
        of_team = F.linear(shared, layer.weight[:, width:], layer.bias)
        if own is None:
            return self._spread(of_team)
        of_rows = F.linear(own, layer.weight[:, :width])
        teams = of_rows.view(len(of_team), -1, of_rows.shape[1])
        return (teams + of_team.unsqueeze(1)).flatten(0, 1)


def apply_linear(layer: nn.Linear, x: th.Tensor | TeamFeatures) -> th.Tensor:
    """Apply a layer to rows, or to what stands for them."""
    return x.linear(layer) if isinstance(x, TeamFeatures) else layer(x)
