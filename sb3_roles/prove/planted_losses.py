"""Bugs that losses have had, each planted in ``stream_loss``.

A mutated loss computes the right one, and then changes the term that is its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch as th

from sb3_roles.common.distributions import kl_divergence, pick
from sb3_roles.common.losses import StreamLoss, stream_loss

Loss = Callable[..., StreamLoss]


def _weights(arguments: dict[str, Any]) -> th.Tensor:
    active = arguments["active"].to(arguments["values"].dtype)
    return active / max(arguments.get("n_active") or float(active.sum()), 1.0)


def _ratio(arguments: dict[str, Any]) -> th.Tensor:
    names = "log_probs", "old_log_probs"
    new, old = (pick(arguments[name], arguments["actions"]) for name in names)
    return (new - old).exp()


def _with_policy_loss(right: StreamLoss, policy_loss: th.Tensor) -> StreamLoss:
    loss = right.loss - right.policy_loss + policy_loss
    return right._replace(policy_loss=policy_loss, loss=loss)


def entropy_discouraged(**arguments: Any) -> StreamLoss:
    """The entropy bonus has the sign of a loss."""
    return stream_loss(**{**arguments, "ent_coef": -arguments["ent_coef"]})


def unclipped(**arguments: Any) -> StreamLoss:
    """The ratio is not clipped."""
    gain = arguments["advantages"] * _ratio(arguments)
    return _with_policy_loss(stream_loss(**arguments), -(_weights(arguments) * gain).sum())


def max_for_min(**arguments: Any) -> StreamLoss:
    """The more hopeful of the two surrogates is taken."""
    ratio, reach = _ratio(arguments), arguments["clip_range"]
    clipped = ratio.clamp(1 - reach, 1 + reach)
    gain = th.max(arguments["advantages"] * ratio, arguments["advantages"] * clipped)
    return _with_policy_loss(stream_loss(**arguments), -(_weights(arguments) * gain).sum())


def kl_reversed(**arguments: Any) -> StreamLoss:
    """The KL divergence goes from the new policy to the old one."""
    right = stream_loss(**arguments)
    reverse = kl_divergence(arguments["log_probs"], arguments["old_log_probs"])
    kl = (_weights(arguments) * reverse).sum()
    return right._replace(kl=kl, loss=right.loss + arguments["kl_coef"] * (kl - right.kl))


def half_value_loss(**arguments: Any) -> StreamLoss:
    """The squared error is halved, as in other texts, while its coefficient is not doubled."""
    right = stream_loss(**arguments)
    half = right.value_loss / 2
    return right._replace(value_loss=half, loss=right.loss - arguments["vf_coef"] * half)


def inactive_counted(**arguments: Any) -> StreamLoss:
    """Rows in which the stream did not decide train its policy, too."""
    return stream_loss(**{**arguments, "active": th.ones_like(arguments["active"])})


def advantage_attached(**arguments: Any) -> StreamLoss:
    """The advantage hangs on the critic: the surrogate trains it, too. All values are right."""
    values = arguments["values"]
    advantages = arguments["advantages"] - (values - values.detach())
    return stream_loss(**{**arguments, "advantages": advantages})


LOSS_BUGS: dict[str, Loss] = {
    "sign of the entropy": entropy_discouraged,
    "ratio not clipped": unclipped,
    "max for min": max_for_min,
    "direction of the KL divergence": kl_reversed,
    "scale of the value loss": half_value_loss,
    "inactive rows counted": inactive_counted,
    "advantage not detached": advantage_attached,
}
