"""The exact joint distribution of role and move, and small helpers on log-probabilities."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from torch import nn
from torch.distributions import Categorical
from torch.nn import functional as F

# Finite, so that 0 * log 0 is 0 and not NaN.
LOG_ZERO = -1.0e9


def role_log_probabilities(logits: th.Tensor, held: th.Tensor, due: th.Tensor) -> th.Tensor:
    """Log-probabilities of the roles, where a role that goes on has probability 1.

    :param logits: float (n, n_roles)
    :param held: float (n, n_roles), one-hot of the role that goes on
    :param due: bool (n,), whether the role policy decides
    :return: float (n, n_roles)
    """
    goes_on = th.where(held > 0.5, 0.0, LOG_ZERO)
    return th.where(due.unsqueeze(1), F.log_softmax(logits, dim=1), goes_on)


def sample_index(log_probs: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
    """Draw one index per row: one uniform number against the cumulative probabilities.

    :param log_probs: float (n, k), normalized
    :param generator: of the same device; None for torch's own
    :return: int64 (n,)
    """
    total = log_probs.exp().cumsum(1)
    uniform = th.rand(len(total), 1, device=total.device, generator=generator) * total[:, -1:]
    return (total <= uniform).sum(1).clamp(max=total.shape[1] - 1)


def quantile_index(log_probs: th.Tensor, uniform: np.ndarray | None) -> np.ndarray:
    """Take the entry of each row at a quantile of its distribution, or the likeliest one.

    :param log_probs: float (n, k), up to a constant per row
    :param uniform: float64 (n,) in [0, 1), the quantiles; None for the likeliest entries
    :return: int64 (n,)
    """
    if uniform is None:
        return log_probs.argmax(1).cpu().numpy()
    total = log_probs.double().softmax(1).cumsum(1).cpu().numpy()
    chosen = (total <= uniform[:, None] * total[:, -1:]).sum(axis=1)
    return np.minimum(chosen, total.shape[1] - 1)


def categorical_logits(distribution: Distribution) -> list[th.Tensor]:
    """Return the parameters of a stock distribution over discrete actions, masks applied.

    :param distribution: of Stable-Baselines3 or sb3-contrib
    :return: float (n, k) for each of the action's entries
    :raises ValueError: if actions are not discrete
    """
    # contrib's masked distributions over several entries have a list of their own.
    made: Any = getattr(distribution, "distributions", None) or distribution.distribution
    parts = made if isinstance(made, list) else [made]
    if not all(isinstance(part, Categorical) for part in parts):
        raise ValueError(f"actions must be discrete, not those of {type(distribution).__name__}")
    return [part.logits for part in parts]


def entropy(log_probs: th.Tensor) -> th.Tensor:
    """Entropy of each row in nats.

    :param log_probs: float (n, k), normalized
    :return: float (n,)
    """
    return -(log_probs.exp() * log_probs).sum(1)


def kl_divergence(old: th.Tensor, new: th.Tensor) -> th.Tensor:
    """Exact KL(old || new) of each row in nats.

    :param old: float (n, k), normalized log-probabilities
    :param new: the same shape
    :return: float (n,)
    """
    return (old.exp() * (old - new)).sum(1)


def pick(values: th.Tensor, index: th.Tensor) -> th.Tensor:
    """Take one entry of each row.

    :param values: (n, k)
    :param index: int64 (n,)
    :return: (n,)
    """
    return values.gather(1, index.unsqueeze(1)).squeeze(1)


class RoleDistribution(Distribution):
    """p(role, move) = p(role) p(move | role), as one flat categorical.

    Log-probabilities, entropies and KL divergences are exact, so that stock PPO, A2C and TRPO can
    use it. Actions are int64 (n, 2): role and move.
    """

    distribution: Categorical

    def proba_distribution_net(self, *args: object, **kwargs: object) -> nn.Module:
        """Refused: the two heads belong to the policy."""
        raise NotImplementedError("the role and move heads are built by RoleActorCriticPolicy")

    def proba_distribution(
        self, role_log_probs: th.Tensor, move_log_probs: th.Tensor
    ) -> RoleDistribution:
        """Set the parameters.

        :param role_log_probs: float (n, n_roles), normalized
        :param move_log_probs: float (n, n_roles, n_moves), normalized over moves
        :return: self
        """
        self.role_log_probs = role_log_probs
        self.move_log_probs = move_log_probs
        joint = role_log_probs.unsqueeze(2) + move_log_probs
        self.distribution = Categorical(logits=joint.flatten(1), validate_args=False)
        return self

    def log_prob(self, actions: th.Tensor) -> th.Tensor:
        """Return log p(role, move), float (n,)."""
        actions = actions.long()
        flat = actions[:, 0] * self.move_log_probs.shape[2] + actions[:, 1]
        return self.distribution.log_prob(flat)

    def entropy(self) -> th.Tensor:
        """Return the entropy of the pair in nats, float (n,)."""
        return self.distribution.entropy()

    def moves(self, roles: th.Tensor) -> th.Tensor:
        """Return the moves' log-probabilities in the given roles, float (n, n_moves).

        :param roles: int64 (n,)
        """
        rows = th.arange(len(roles), device=roles.device)
        return self.move_log_probs[rows, roles]

    def sample(self) -> th.Tensor:
        """Draw a role and then a move, int64 (n, 2)."""
        roles = sample_index(self.role_log_probs)
        return th.stack([roles, sample_index(self.moves(roles))], dim=1)

    def mode(self) -> th.Tensor:
        """Return the most probable role and the most probable move in it, int64 (n, 2)."""
        roles = self.role_log_probs.argmax(1)
        return th.stack([roles, self.moves(roles).argmax(1)], dim=1)

    def actions_from_params(
        self, role_log_probs: th.Tensor, move_log_probs: th.Tensor, deterministic: bool = False
    ) -> th.Tensor:
        """Return actions for given parameters, int64 (n, 2)."""
        self.proba_distribution(role_log_probs, move_log_probs)
        return self.get_actions(deterministic=deterministic)

    def log_prob_from_params(
        self, role_log_probs: th.Tensor, move_log_probs: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return sampled actions and their log-probabilities."""
        actions = self.actions_from_params(role_log_probs, move_log_probs)
        return actions, self.log_prob(actions)
