"""Bugs that rollout buffers have had, each planted in ``TeamRolloutBuffer``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch as th

from sb3_roles.common.buffers import TeamRolloutBuffer, TeamSamples


class TeamsMixed(TeamRolloutBuffer):
    """Minibatches are permutations of rows, as in stock buffers."""

    def samples(self, index: th.Tensor) -> TeamSamples:
        """Gather pairs, and tear their teams apart."""
        whole = super().samples(index)
        order = th.arange(len(whole.actions)).roll(1)

        def mixed(value: th.Tensor) -> th.Tensor:
            return value[order] if len(value) == len(order) else value

        return TeamSamples(
            {key: mixed(value) for key, value in whole.observations.items()},
            mixed(whole.actions),
            tuple(mixed(value) for value in whole.old_log_probs),
            mixed(whole.advantages),
            mixed(whole.returns),
            mixed(whole.active),
        )


class _OtherReturns(TeamRolloutBuffer):
    """Computes returns of changed numbers."""

    def compute_stream_returns(
        self,
        last_expected_values: th.Tensor,
        gamma: th.Tensor,
        gae_lambda: th.Tensor,
        normalize_advantage: bool,
    ) -> None:
        """Compute them as the buffer does, of what :meth:`changed` makes of its numbers."""
        kept = self._rewards, self._expected_values, self._ends
        self._rewards, self._expected_values, self._ends, last = self.changed(last_expected_values)
        super().compute_stream_returns(last, gamma, gae_lambda, normalize_advantage)
        self._rewards, self._expected_values, self._ends = kept

    def changed(self, last: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Return rewards, expected values, ends and last expected values."""
        raise NotImplementedError


class OffByOne(_OtherReturns):
    """The value of the same step is taken for that of the next one."""

    def changed(self, last: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Shift the values."""
        return self._rewards, self._expected_values.roll(1, 0), self._ends, last


class DoneIgnored(_OtherReturns):
    """The next episode's return is taken for what would have followed."""

    def changed(self, last: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Forget the ends."""
        return self._rewards, self._expected_values, th.zeros_like(self._ends), last


class LastValueMissing(_OtherReturns):
    """What follows the last step is taken to be worth nothing."""

    def changed(self, last: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Forget the value after the last step."""
        return self._rewards, self._expected_values, self._ends, th.zeros_like(last)


class BootstrappedTwice(_OtherReturns):
    """The value at an end is added to a reward that holds it already."""

    def changed(self, last: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """Add it once more."""
        following = th.cat([self._expected_values[1:], last[None]])
        rewards = self._rewards + self._ends.unsqueeze(2) * following
        return rewards, self._expected_values, self._ends, last


class RowTwice(TeamRolloutBuffer):
    """Pairs are drawn with replacement: some come twice, others never."""

    def pairs(self, batch_teams: int | None) -> Any:
        """Number pairs, each drawn on its own."""
        return self._drawn(batch_teams or self.buffer_size * self.n_teams)

    def _drawn(self, batch_teams: int) -> Iterator[th.Tensor]:
        n = self.buffer_size * self.n_teams
        drawn = th.randint(n, (n,), generator=th.Generator().manual_seed(0))
        for start in range(0, n, batch_teams):
            yield drawn[start : start + batch_teams]


class WrongAxis(TeamRolloutBuffer):
    """Advantages are normalized over the streams together, and over rows that do not decide."""

    def compute_stream_returns(
        self,
        last_expected_values: th.Tensor,
        gamma: th.Tensor,
        gae_lambda: th.Tensor,
        normalize_advantage: bool,
    ) -> None:
        """Compute returns, and normalize all advantages as one set of numbers."""
        super().compute_stream_returns(last_expected_values, gamma, gae_lambda, False)
        if normalize_advantage:
            every = self._advantages
            self._advantages = (every - every.mean()) / (every.std() + 1e-8)


BUFFER_BUGS: dict[str, type[TeamRolloutBuffer]] = {
    "teams mixed": TeamsMixed,
    "value off by one step": OffByOne,
    "end of the episode ignored": DoneIgnored,
    "last value missing": LastValueMissing,
    "truncation bootstrapped twice": BootstrappedTwice,
    "rows twice and never": RowTwice,
    "normalized over the wrong axes": WrongAxis,
}
