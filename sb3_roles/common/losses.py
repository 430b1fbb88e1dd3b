"""Returns and the PPO objective: one function of each, for every stream of decisions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch as th
from torch.nn import functional as F

from sb3_roles.common.distributions import entropy, kl_divergence, pick

# RLlib's rule for its KL penalty, which the paper trained with.
_KL_HIGH, _KL_LOW, _KL_UP, _KL_DOWN = 2.0, 0.5, 1.5, 0.5
# Our bounds on it: without, a long calm phase would switch the penalty off for good.
_KL_COEF_MIN, _KL_COEF_MAX = 1.0e-4, 1.0e2
# On CPUs at most 1e-8 was seen, with bfloat16, too; GPUs choose products by the number of rows, and
# what bfloat16 makes of that was not measured.
_SAME_KL, _SAME_KL_ELSEWHERE = 1.0e-4, 1.0e-2


def lambda_returns(
    rewards: th.Tensor,
    expected_values: th.Tensor,
    last_expected_values: th.Tensor,
    ends: th.Tensor,
    gamma: th.Tensor,
    gae_lambda: th.Tensor,
) -> th.Tensor:
    """TD(lambda) returns of every stream.

    G_t = r_t + gamma (1 - end_t) ((1 - lambda) E_{t+1} + lambda G_{t+1}), where E is the value
    before the next choice is made. The generalized advantage estimate is G_t - V_t: with V = E it
    is the usual one; for a critic that is conditioned on the role, V_t is the value of the role
    that was taken and E_{t+1} the expectation over the next role.

    :param rewards: float (T, n, S); the value at a truncation is added to them already
    :param expected_values: float (T, n, S)
    :param last_expected_values: float (n, S), after the last step
    :param ends: bool (T, n), whether the episode ended with this step
    :param gamma: float (S,)
    :param gae_lambda: float (S,)
    :return: float (T, n, S)
    """
    returns = th.empty_like(rewards)
    following = next_expected = last_expected_values
    for t in reversed(range(len(rewards))):
        goes_on = (~ends[t]).unsqueeze(1).to(rewards.dtype)
        mixed = (1.0 - gae_lambda) * next_expected + gae_lambda * following
        following = rewards[t] + gamma * goes_on * mixed
        returns[t] = following
        next_expected = expected_values[t]
    return returns


class StreamLoss(NamedTuple):
    """The objective of one stream on one minibatch, and its parts (scalars)."""

    loss: th.Tensor
    policy_loss: th.Tensor
    value_loss: th.Tensor
    entropy: th.Tensor
    kl: th.Tensor
    clip_fraction: th.Tensor


def stream_loss(
    log_probs: th.Tensor,
    values: th.Tensor,
    actions: th.Tensor,
    old_log_probs: th.Tensor,
    advantages: th.Tensor,
    returns: th.Tensor,
    active: th.Tensor,
    clip_range: float,
    ent_coef: float,
    vf_coef: float,
    kl_coef: float,
    n_active: float | None = None,
    n_rows: int | None = None,
) -> StreamLoss:
    """L = L_CLIP + c1 L_KL + c2 L_VF + c3 L_E, to be minimized (Eqs. 4 and 8).

    Of a part of a minibatch, all terms are shares of those of the whole: they add up to them.

    :param log_probs: float (n, k), normalized, of the policy that learns
    :param values: float (n,)
    :param actions: int64 (n,)
    :param old_log_probs: float (n, k), of the policy that acted: the KL divergence is exact
    :param advantages: float (n,)
    :param returns: float (n,)
    :param active: bool (n,), rows in which the stream decided; the others train its critic only
    :param n_active: number of such rows in the whole minibatch; by default this is the whole
    :param n_rows: number of rows in the whole minibatch; by default this is the whole
    """
    weight = active.to(values.dtype)
    weight = weight / (weight.sum().clamp(min=1.0) if n_active is None else max(n_active, 1.0))
    ratio = (pick(log_probs, actions) - pick(old_log_probs, actions)).exp()
    clipped = ratio.clamp(1.0 - clip_range, 1.0 + clip_range)
    policy_loss = -(weight * th.min(advantages * ratio, advantages * clipped)).sum()
    value_loss = F.mse_loss(values, returns, reduction="sum") / (n_rows or len(values))
    mean_entropy = (weight * entropy(log_probs)).sum()
    kl = (weight * kl_divergence(old_log_probs, log_probs)).sum()
    loss = policy_loss + kl_coef * kl + vf_coef * value_loss - ent_coef * mean_entropy
    with th.no_grad():
        clip_fraction = (weight * ((ratio - 1.0).abs() > clip_range)).sum()
    return StreamLoss(loss, policy_loss, value_loss, mean_entropy, kl, clip_fraction)


def check_same_policy(names: Sequence[str], losses: Sequence[StreamLoss]) -> None:
    """Refuse a first minibatch whose policy is not the one that acted.

    Before the first step the weights are those of the rollout: every ratio is 1 and the KL
    divergence 0, up to rounding, which depends on the number of rows.

    :param names: of the streams
    :param losses: of the first minibatch after a rollout, one for each stream
    :raises ValueError: if a stream's divergence is more than rounding
    """
    for name, loss in zip(names, losses, strict=True):
        kl = float(loss.kl)
        limit = _SAME_KL if loss.kl.device.type == "cpu" else _SAME_KL_ELSEWHERE
        if kl > limit:
            raise ValueError(
                f"the {name} policy that learns is not the one that acted: before the first step "
                f"they diverge by {kl:.2g} nats, more than the {limit:g} of rounding; a layer "
                "such as dropout or batch normalization computes differently while training"
            )


def adapt_kl_coef(kl_coef: float, kl: float, kl_target: float) -> float:
    """Raise the penalty when a step went too far, lower it when it was timid.

    :param kl_coef: the coefficient so far
    :param kl: mean KL divergence of the last update in nats
    :param kl_target: the divergence to aim at
    :return: the next coefficient
    """
    if kl > _KL_HIGH * kl_target:
        kl_coef *= _KL_UP
    elif kl < _KL_LOW * kl_target:
        kl_coef *= _KL_DOWN
    return min(max(kl_coef, _KL_COEF_MIN), _KL_COEF_MAX)
