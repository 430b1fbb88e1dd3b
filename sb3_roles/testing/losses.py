"""The PPO objective of one stream, row by row in plain Python, and the check against it."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch as th

from sb3_roles.common.checks import check_positive, check_whole
from sb3_roles.testing.episodes import ConformanceError

LossFunction = Callable[..., Any]
TERMS = ("policy_loss", "value_loss", "entropy", "kl", "clip_fraction", "loss")
_STEP = 1e-6


class Minibatch(NamedTuple):
    """What a loss is made of, float64; n rows, k choices."""

    logits: np.ndarray
    """(n, k)"""
    values: np.ndarray
    """(n,)"""
    actions: np.ndarray
    """int64 (n,)"""
    old_log_probs: np.ndarray
    """(n, k)"""
    advantages: np.ndarray
    """(n,)"""
    returns: np.ndarray
    """(n,)"""
    active: np.ndarray
    """bool (n,)"""


class Coefficients(NamedTuple):
    """How its terms are weighted."""

    clip_range: float
    ent_coef: float
    vf_coef: float
    kl_coef: float


def _log_softmax(row: np.ndarray) -> list[float]:
    top = float(max(row))
    total = math.log(sum(math.exp(float(x) - top) for x in row)) + top
    return [float(x) - total for x in row]


def slow_loss(batch: Minibatch, coefficients: Coefficients) -> dict[str, float]:
    """Return the terms of Eqs. 4 and 8, summed row by row.

    :param batch: the rows
    :param coefficients: of the terms
    :return: by name, see ``TERMS``
    """
    low, high = 1 - coefficients.clip_range, 1 + coefficients.clip_range
    sums = dict.fromkeys(TERMS, 0.0)
    n_active = max(1, int(batch.active.sum()))
    for i, row in enumerate(batch.logits):
        sums["value_loss"] += float(batch.values[i] - batch.returns[i]) ** 2 / len(batch.logits)
        if not batch.active[i]:
            continue
        new, old = _log_softmax(row), [float(x) for x in batch.old_log_probs[i]]
        action, advantage = int(batch.actions[i]), float(batch.advantages[i])
        ratio = math.exp(new[action] - old[action])
        gain = min(ratio * advantage, min(max(ratio, low), high) * advantage)
        sums["policy_loss"] -= gain / n_active
        sums["entropy"] -= sum(math.exp(x) * x for x in new) / n_active
        sums["kl"] += sum(math.exp(o) * (o - x) for o, x in zip(old, new, strict=True)) / n_active
        sums["clip_fraction"] += (abs(ratio - 1) > coefficients.clip_range) / n_active
    sums["loss"] = (
        sums["policy_loss"]
        + coefficients.kl_coef * sums["kl"]
        + coefficients.vf_coef * sums["value_loss"]
        - coefficients.ent_coef * sums["entropy"]
    )
    return sums


def random_minibatch(seed: int, rows: int = 9, choices: int = 4) -> Minibatch:
    """Draw rows whose ratios lie below, within and above the clip range.

    :param seed: of the numbers
    :param rows: n
    :param choices: k
    """
    rng = np.random.default_rng(seed)
    old = np.array([_log_softmax(row) for row in rng.normal(size=(rows, choices))])
    active = rng.random(rows) < 0.6
    active[:2] = True, False
    return Minibatch(
        old + rng.normal(0.0, 0.5, (rows, choices)),
        rng.normal(size=rows),
        rng.integers(0, choices, rows),
        old,
        rng.normal(size=rows),
        rng.normal(size=rows),
        active,
    )


def _call(function: LossFunction, batch: Minibatch, coefficients: Coefficients) -> Any:
    logits = th.as_tensor(batch.logits).clone().requires_grad_()
    values = th.as_tensor(batch.values).clone().requires_grad_()
    result = function(
        log_probs=th.log_softmax(logits, dim=1),
        values=values,
        actions=th.as_tensor(batch.actions),
        old_log_probs=th.as_tensor(batch.old_log_probs),
        advantages=th.as_tensor(batch.advantages),
        returns=th.as_tensor(batch.returns),
        active=th.as_tensor(batch.active),
        **coefficients._asdict(),
    )
    return result, logits, values


def _slope(batch: Minibatch, name: str, index: tuple[int, ...], c: Coefficients) -> float:
    """Return the derivative of the slow loss by one number, by central differences."""
    ends = []
    for sign in (1, -1):
        array = getattr(batch, name).copy()
        array[index] += sign * _STEP
        ends.append(slow_loss(batch._replace(**{name: array}), c)["loss"])
    return (ends[0] - ends[1]) / (2 * _STEP)


def _check_one(function: LossFunction, batch: Minibatch, c: Coefficients) -> None:
    result, logits, values = _call(function, batch, c)
    expected = slow_loss(batch, c)
    for name in TERMS:
        found = float(getattr(result, name).detach())
        if not math.isclose(found, expected[name], rel_tol=1e-8, abs_tol=1e-8):
            raise ConformanceError(
                f"{name} is {found:.8g}, expected {expected[name]:.8g}; with {c}"
            )
    gradients = th.autograd.grad(result.loss, (logits, values), allow_unused=True)
    for name, gradient in zip(("logits", "values"), gradients, strict=True):
        shape = getattr(batch, name).shape
        slopes = np.zeros(shape) if gradient is None else gradient.numpy()
        for index in np.ndindex(*slopes.shape):
            slope = _slope(batch, name, index, c)
            if not math.isclose(float(slopes[index]), slope, rel_tol=1e-4, abs_tol=1e-6):
                kind = "decides" if batch.active[index[0]] else "does not decide"
                raise ConformanceError(
                    f"the gradient by {name}{list(index)} (a row that {kind}) is "
                    f"{slopes[index]:.6g}, expected {slope:.6g} by finite differences; with {c}"
                )


def check_stream_loss(loss_function: LossFunction, seed: int = 0, n_batches: int = 3) -> None:
    """Check a function with the signature of ``sb3_roles.common.losses.stream_loss``.

    Each term and their sum are compared with a slow reference, the gradient by logits and values
    with its finite differences: clipping on both sides and for both signs of the advantage, the
    direction of the KL divergence, rows in which the stream does not decide (they train the critic
    only), a minibatch without any decision; and parts of a minibatch must add up to the whole.

    Example: ``check_stream_loss(stream_loss)``

    :param loss_function: takes and returns what ``stream_loss`` does, in float64 here
    :param seed: of the minibatches
    :param n_batches: how many to try
    :raises ConformanceError: naming the term, or the row of a gradient, and what was expected
    :raises ValueError: if a number is not allowed
    """
    check_whole(0, seed=seed)
    check_positive(n_batches=n_batches)
    plain = Coefficients(clip_range=0.2, ent_coef=0.0, vf_coef=0.0, kl_coef=0.0)
    whole = Coefficients(clip_range=0.2, ent_coef=0.03, vf_coef=0.7, kl_coef=0.4)
    for k in range(n_batches):
        batch = random_minibatch(seed + k)
        for c in (plain, whole):
            _check_one(loss_function, batch, c)
    nobody = random_minibatch(seed)
    _check_one(loss_function, nobody._replace(active=np.zeros_like(nobody.active)), whole)
    _check_parts(loss_function, random_minibatch(seed, rows=12), whole)


def _check_parts(function: LossFunction, batch: Minibatch, c: Coefficients) -> None:
    sizes = {"n_active": float(batch.active.sum()), "n_rows": len(batch.values)}

    def with_sizes(**arguments: Any) -> Any:
        return function(**arguments, **sizes)

    expected = slow_loss(batch, c)
    parts = [
        _call(with_sizes, Minibatch(*(array[low : low + 4] for array in batch)), c)[0]
        for low in (0, 4, 8)
    ]
    for name in TERMS:
        total = sum(float(getattr(part, name).detach()) for part in parts)
        if not math.isclose(total, expected[name], rel_tol=1e-8, abs_tol=1e-8):
            raise ConformanceError(
                f"{name} of the three parts of a minibatch adds up to {total:.8g}, expected that "
                f"of the whole, {expected[name]:.8g}"
            )
