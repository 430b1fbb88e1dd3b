"""The check of a rollout buffer of teams."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_roles.common.checks import check_positive, check_whole
from sb3_roles.common.policies import Streams
from sb3_roles.testing.episodes import ConformanceError
from sb3_roles.testing.returns import Rollout, check_same_returns, slow_returns

MakeBuffer = Callable[..., Any]
_CHOICES = (2, 5)
_GAMMA, _LAMBDA = np.array([0.9, 0.5]), np.array([0.8, 0.3])
_SPACE = spaces.Dict(
    {
        "where": spaces.Box(-np.inf, np.inf, (3,), np.float32),
        "own": spaces.Box(0, 255, (2, 4, 5), np.uint8),
        "shared": spaces.Box(0, 255, (3, 6, 4), np.uint8),
        "flags": spaces.Box(0, 1, (2, 5, 3), np.uint8),
        "agent": spaces.Box(0, np.inf, (2,), np.float32),
    }
)


@dataclass
class _Filled:
    """What was put into a buffer; rows of observations know their step, team and robot."""

    n_agents: int
    observations: list[dict[str, th.Tensor]]
    chosen: list[Streams]
    rollout: Rollout

    @property
    def n_rows(self) -> int:
        return self.rollout.rewards.shape[1]


def _log_probs(observations: dict[str, th.Tensor], n_agents: int) -> list[th.Tensor]:
    """Return what a policy would say that mixes each row with its team mates."""
    own = observations["own"].double().flatten(1)[:, : sum(_CHOICES)] / 255
    teams = own.view(-1, n_agents, own.shape[1])
    mixed = (own + teams.mean(dim=1).repeat_interleave(n_agents, dim=0)).float()
    return [part.log_softmax(1) for part in mixed.split(list(_CHOICES), dim=1)]


def _fill(buffer: Any, steps: int, n_teams: int, n_agents: int, seed: int) -> _Filled:
    rng = np.random.default_rng(seed)
    n_rows = n_teams * n_agents
    team, agent = np.divmod(np.arange(n_rows), n_agents)
    seen, said, rewards, ends = [], [], [], []
    for t in range(steps):
        arrays = {
            "where": np.stack([np.full(n_rows, t), team, agent], axis=1).astype(np.float32),
            "own": rng.integers(0, 255, (n_rows, 2, 4, 5)).astype(np.uint8),
            "shared": rng.integers(0, 255, (n_teams, 3, 6, 4)).astype(np.uint8),
            "flags": rng.integers(0, 2, (n_rows, 2, 5, 3)).astype(np.uint8),
            "agent": np.stack([agent, np.full(n_rows, n_agents)], axis=1).astype(np.float32),
        }
        observations = {key: th.as_tensor(array) for key, array in arrays.items()}
        numbers = th.as_tensor(rng.normal(size=(3, n_rows, 2)), dtype=th.float32)
        chosen = Streams(
            actions=th.as_tensor(rng.integers(0, _CHOICES, (n_rows, 2))),
            log_probs=tuple(_log_probs(observations, n_agents)),
            values=numbers[0],
            expected_values=numbers[1],
            active=th.as_tensor(rng.random((n_rows, 2)) < 0.5),
        )
        over = th.as_tensor(rng.random(n_teams) < 0.3).repeat_interleave(n_agents)
        buffer.add_streams(observations, chosen, numbers[2], over)
        seen.append(observations)
        said.append(chosen)
        rewards.append(numbers[2].double().numpy())
        ends.append(over.numpy())
    rollout = Rollout(
        np.stack(rewards),
        np.stack([one.expected_values.double().numpy() for one in said]),
        rng.normal(size=(n_rows, 2)).astype(np.float32).astype(np.float64),
        np.stack(ends),
    )
    return _Filled(n_agents, seen, said, rollout)


def _check_rows(samples: Any, filled: _Filled, batch: int, counts: np.ndarray) -> np.ndarray:
    """Check that rows are whole teams, in order, each with what was put in; return their places."""
    where = samples.observations["where"].long().numpy()
    n_agents, label = filled.n_agents, f"minibatch {batch}"
    if len(where) % n_agents:
        raise ConformanceError(
            f"{label}: expected whole teams of {n_agents} rows, got {len(where)} rows"
        )
    for i, (t, team, agent) in enumerate(where):
        first = where[i - i % n_agents]
        if agent != i % n_agents or t != first[0] or team != first[1]:
            raise ConformanceError(
                f"{label}, row {i}: expected agent {i % n_agents} of step {first[0]}, team "
                f"{first[1]}, got agent {agent} of step {t}, team {team}: teams must stay together"
            )
        row = team * n_agents + agent
        counts[t, row] += 1
        said, seen = filled.chosen[t], filled.observations[t]
        pairs = {
            "the action": (samples.actions[i], said.actions[row]),
            "whether it decided": (samples.active[i], said.active[row]),
        }
        for s, old in enumerate(samples.old_log_probs):
            pairs[f"the log-probabilities of stream {s}"] = (old[i], said.log_probs[s][row])
        for key, value in samples.observations.items():
            once = len(value) * n_agents == len(where)
            given = seen[key][team if len(seen[key]) < filled.n_rows else row]
            pairs[f"the observation {key!r}"] = (value[i // n_agents if once else i], given)
        for name, (found, expected) in pairs.items():
            if found.shape != expected.shape or not th.equal(found, expected):
                raise ConformanceError(
                    f"{label}, row {i}: {name} is not that of agent {agent}, step {t}, team {team}"
                )
    return where


def _check_ratio(samples: Any, filled: _Filled, batch: int) -> None:
    for s, new in enumerate(_log_probs(samples.observations, filled.n_agents)):
        index = samples.actions[:, s : s + 1]
        ratio = (new.gather(1, index) - samples.old_log_probs[s].gather(1, index)).exp().flatten()
        wrong = (ratio - 1).abs() > 1e-5
        if wrong.any():
            i = int(wrong.nonzero()[0])
            raise ConformanceError(
                f"minibatch {batch}, row {i}, stream {s}: with the weights that acted the ratio of "
                f"probabilities must be 1, got {float(ratio[i]):.6g}"
            )


def _check_pass(buffer: Any, filled: _Filled, batch_teams: int) -> np.ndarray:
    """Check one pass; return the returns and advantages by place, float64 (2, T, n, S)."""
    shape = filled.rollout.rewards.shape
    counts, numbers = np.zeros(shape[:2], int), np.full((2, *shape), np.nan)
    for batch, samples in enumerate(buffer.minibatches(batch_teams)):
        where = _check_rows(samples, filled, batch, counts)
        _check_ratio(samples, filled, batch)
        rows = where[:, 1] * filled.n_agents + where[:, 2]
        numbers[0, where[:, 0], rows] = samples.returns.double().numpy()
        numbers[1, where[:, 0], rows] = samples.advantages.double().numpy()
    if (counts != 1).any():
        t, row = (int(i) for i in np.argwhere(counts != 1)[0])
        team, agent = divmod(row, filled.n_agents)
        raise ConformanceError(
            f"agent {agent}, step {t}, team {team}: expected once in a pass, got {counts[t, row]} "
            "times"
        )
    return numbers


def _check_advantages(numbers: np.ndarray, filled: _Filled, normalized: bool) -> None:
    values = np.stack([one.values.double().numpy() for one in filled.chosen])
    active = np.stack([one.active.numpy() for one in filled.chosen])
    expected, label = numbers[0] - values, "return minus value"
    if normalized:
        label = "scaled to mean 0 and deviation 1 over the rows in which its stream decided"
        for s in range(expected.shape[2]):
            used = expected[..., s][active[..., s]]
            if len(used) > 1:  # A single number has no deviation.
                expected[..., s] = (expected[..., s] - used.mean()) / (used.std(ddof=1) + 1e-8)
    wrong = ~np.isclose(numbers[1], expected, rtol=1e-4, atol=1e-4)
    if wrong.any():
        t, row, s = (int(i) for i in np.argwhere(wrong)[0])
        raise ConformanceError(
            f"the advantage of step {t}, row {row}, stream {s} is {numbers[1, t, row, s]:.6g}, "
            f"expected {expected[t, row, s]:.6g}: {label}"
        )


def check_team_buffer(
    make_buffer: MakeBuffer,
    seed: int = 0,
    n_teams: int = 4,
    n_agents: int = 3,
    steps: int = 6,
    batches: tuple[int, ...] = (1, 3, 1000),
) -> None:
    """Check a buffer with the interface of ``sb3_roles.common.buffers.TeamRolloutBuffer``.

    In every pass each row comes once, with all that was put in, in whole teams and in order; with
    the weights that acted the ratio of probabilities is 1, also for a policy that mixes team mates;
    returns are those of the definition, advantages are returns minus values, normalized over the
    rows in which a stream decided; a second rollout finds nothing of the first.

    Example: ``check_team_buffer(TeamRolloutBuffer)``

    :param make_buffer: takes the arguments of ``TeamRolloutBuffer``, as its class does
    :param seed: of what is put in
    :param n_teams: teams
    :param n_agents: rows of a team
    :param steps: steps of a rollout
    :param batches: sizes of minibatches in teams to try
    :raises ConformanceError: naming agent or row, step, and what was expected
    :raises ValueError: if a number is not allowed
    """
    check_whole(0, seed=seed)
    check_positive(
        n_teams=n_teams, n_agents=n_agents, steps=steps, **{"len(batches)": len(batches)}
    )
    buffer = make_buffer(
        steps,
        _SPACE,
        spaces.MultiDiscrete(list(_CHOICES)),
        "cpu",
        gae_lambda=0.8,
        gamma=0.9,
        n_envs=n_teams * n_agents,
    )
    gamma, gae_lambda = (th.as_tensor(a, dtype=th.float32) for a in (_GAMMA, _LAMBDA))
    for k, normalized in enumerate((False, True)):
        buffer.reset()
        filled = _fill(buffer, steps, n_teams, n_agents, seed + k)
        last = th.as_tensor(filled.rollout.last_expected_values, dtype=th.float32)
        buffer.compute_stream_returns(last, gamma, gae_lambda, normalized)
        expected = slow_returns(filled.rollout, _GAMMA, _LAMBDA)
        for batch_teams in batches:
            numbers = _check_pass(buffer, filled, batch_teams)
            check_same_returns(numbers[0], filled.rollout, expected, 1e-4)
            _check_advantages(numbers, filled, normalized)
