"""Returns by their definition, slow and obvious, and the check that holds a function to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch as th

from sb3_roles.common.checks import check_positive, check_whole
from sb3_roles.testing.episodes import ConformanceError

ReturnsFunction = Callable[..., th.Tensor]


class Rollout(NamedTuple):
    """What returns are made of; T steps, n rows, S streams."""

    rewards: np.ndarray
    """float64 (T, n, S); with the value at a truncation already added"""
    expected_values: np.ndarray
    """float64 (T, n, S), before each choice"""
    last_expected_values: np.ndarray
    """float64 (n, S), after the last step"""
    ends: np.ndarray
    """bool (T, n), whether the episode ended with the step"""


def random_rollout(seed: int, steps: int = 23, rows: int = 4, streams: int = 2) -> Rollout:
    """Draw a rollout with ends in its midst, at its last step and not there.

    :param seed: of the numbers
    :param steps: T
    :param rows: n, at least 2
    :param streams: S
    """
    rng = np.random.default_rng(seed)
    rewards, values = rng.normal(size=(2, steps, rows, streams))
    ends = rng.random((steps, rows)) < 0.2
    ends[-1, 0], ends[-1, 1] = True, False
    return Rollout(rewards, values, rng.normal(size=(rows, streams)), ends)


def forward_view(
    rewards: np.ndarray,
    following_values: np.ndarray,
    ends: np.ndarray,
    gamma: float,
    gae_lambda: float,
    t: int,
) -> float:
    """Return the lambda return of one step by its definition: a weighted mean of n-step returns.

    :param rewards: (T,)
    :param following_values: (T,), the value after each step
    :param ends: (T,)
    :param gamma: discount
    :param gae_lambda: lambda; the n-step return weighs (1 - lambda) lambda^(n - 1), the last one
        all that is left
    :param t: the step
    """
    n_step, total, discount = [], 0.0, 1.0
    for k in range(t, len(rewards)):
        total += discount * float(rewards[k])
        discount *= gamma
        n_step.append(total + (0.0 if ends[k] else discount * float(following_values[k])))
        if ends[k]:
            break
    last = len(n_step) - 1
    weights = [*((1 - gae_lambda) * gae_lambda**n for n in range(last)), gae_lambda**last]
    return sum(w * g for w, g in zip(weights, n_step, strict=True))


def slow_returns(rollout: Rollout, gamma: np.ndarray, gae_lambda: np.ndarray) -> np.ndarray:
    """Return what :func:`~sb3_roles.common.losses.lambda_returns` should, step by step.

    :param rollout: of T steps, n rows, S streams
    :param gamma: (S,)
    :param gae_lambda: (S,)
    :return: float64 (T, n, S)
    """
    rewards, values, last, ends = rollout
    following = np.concatenate([values[1:], last[None]])
    returns = np.zeros_like(rewards)
    for t, row, s in np.ndindex(*rewards.shape):
        returns[t, row, s] = forward_view(
            rewards[:, row, s],
            following[:, row, s],
            ends[:, row],
            float(gamma[s]),
            float(gae_lambda[s]),
            t,
        )
    return returns


def check_same_returns(
    found: np.ndarray, rollout: Rollout, expected: np.ndarray, tolerance: float
) -> None:
    """Refuse returns that are not those expected.

    :param found: float (T, n, S)
    :param rollout: of which they are
    :param expected: float (T, n, S)
    :param tolerance: relative and absolute
    :raises ConformanceError: naming step, row and stream
    """
    if found.shape != expected.shape:
        raise ConformanceError(
            f"returns must have the shape {expected.shape} (steps, rows, streams), "
            f"got {found.shape}"
        )
    wrong = ~np.isclose(found, expected, rtol=tolerance, atol=tolerance)
    if not wrong.any():
        return
    t, row, s = (int(i) for i in np.argwhere(wrong)[-1])
    at = "the episode ends there" if rollout.ends[t, row] else "the episode goes on"
    if t == len(found) - 1:
        at = f"the last step, {at}"
    raise ConformanceError(
        f"the return of step {t}, row {row}, stream {s} ({at}) is {found[t, row, s]:.6g}, "
        f"expected {expected[t, row, s]:.6g}; {int(wrong.sum())} of {wrong.size} differ"
    )


def check_returns(function: ReturnsFunction, seed: int = 0, n_rollouts: int = 3) -> None:
    """Check a function with the signature of ``sb3_roles.common.losses.lambda_returns``.

    Against the definition, in float64: ends within a rollout and at its last step, the value after
    it, and streams with gamma and lambda of their own, 0 and 1 among them.

    Example: ``check_returns(lambda_returns)``

    :param function: takes rewards, expected values, last expected values, ends, gamma, lambda;
        returns float (T, n, S)
    :param seed: of the rollouts
    :param n_rollouts: how many to try
    :raises ConformanceError: naming step, row and stream
    :raises ValueError: if a number is not allowed
    """
    check_whole(0, seed=seed)
    check_positive(n_rollouts=n_rollouts)
    gamma, gae_lambda = np.array([0.9, 0.7, 1.0, 0.5]), np.array([0.95, 0.4, 1.0, 0.0])
    for k in range(n_rollouts):
        rollout = random_rollout(seed + k, steps=7 + 8 * k, streams=len(gamma))
        given = [th.as_tensor(array.copy()) for array in rollout]
        found = function(*given, th.as_tensor(gamma), th.as_tensor(gae_lambda))
        expected = slow_returns(rollout, gamma, gae_lambda)
        check_same_returns(found.detach().numpy(), rollout, expected, 1e-9)
