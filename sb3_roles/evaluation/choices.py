"""Roles and moves from any actor-critic policy, drawn with numbers that are given."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.preprocessing import maybe_transpose

from sb3_roles.common.distributions import RoleDistribution, categorical_logits, quantile_index
from sb3_roles.common.policies import TeamPolicy
from sb3_roles.common.row_policies import row_masks

Rows = Mapping[str, np.ndarray]


class ActionChooser:
    """Asks a policy for its distribution and picks from it, without a global generator.

    Policies of whole teams, of single robots, masked ones and recurrent ones are all served; the
    states of an LSTM are kept from step to step.

    :param policy: with discrete actions: a move, or a role and a move
    :param communicate: False switches the messages between robots off
    :raises ValueError: if it is no actor-critic policy
    """

    def __init__(self, policy: BasePolicy, communicate: bool) -> None:
        if not isinstance(policy, (ActorCriticPolicy, MaskableActorCriticPolicy)):
            raise ValueError(
                f"only actor-critic policies can be played, not {type(policy).__name__}"
            )
        self.policy = policy
        self.communicate = communicate
        self.start(0, False)

    def start(self, n_rows: int, blocked_moves: bool) -> None:
        """Begin an episode in every team.

        :param n_rows: number of robots
        :param blocked_moves: mask those of area search, see ``MaskWrapper``
        """
        self._n_rows, self._blocked_moves = n_rows, blocked_moves
        self._lstm_states: Any = None

    def choose(self, rows: Rows, draws: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Choose a role and a move for each row.

        :param rows: observations of all rows; what a team shares once per row or, for policies of
            teams, once per team
        :param draws: float64 (rows, 2) in [0, 1), from which role and move are drawn; None for the
            likeliest ones
        :return: roles and moves, int64 (rows,) each; without roles both are the moves
        :raises ValueError: if the policy reads what robots do not know
        """
        columns = (None, None) if draws is None else (draws[:, 0], draws[:, 1])
        with _evaluating(self.policy), th.inference_mode():
            if isinstance(self.policy, TeamPolicy):
                distribution = self._of_teams(self.policy, rows)
            else:
                distribution = self._of_rows(rows)
            if isinstance(distribution, RoleDistribution):
                roles = quantile_index(distribution.role_log_probs, columns[0])
                moves = distribution.moves(th.as_tensor(roles))
                return roles, quantile_index(moves, columns[1])
            logits = categorical_logits(distribution)
        picked = [quantile_index(one, columns[k - len(logits)]) for k, one in enumerate(logits)]
        return picked[0], picked[-1]

    def _of_teams(self, policy: TeamPolicy, rows: Rows) -> Distribution:
        communicate, policy.communicate = policy.communicate, self.communicate
        try:
            return policy.get_distribution(policy.obs_to_tensor(rows)[0])
        finally:
            policy.communicate = communicate

    def _of_rows(self, rows: Rows) -> Distribution:
        policy, space = self.policy, self.policy.observation_space
        observation: Any
        if isinstance(space, spaces.Dict):
            known = {key: one for key, one in space.spaces.items() if key in rows}
            observation = {key: self._tensor(rows[key], one) for key, one in known.items()}
        else:
            observation = self._tensor(rows["observation"], space)
        try:
            if isinstance(policy, MaskableActorCriticPolicy):
                masks = row_masks(rows, policy.action_space, self._blocked_moves)
                return policy.get_distribution(observation, action_masks=masks)
            if isinstance(policy, RecurrentActorCriticPolicy):
                return self._recurrent(policy, observation)
            assert isinstance(policy, ActorCriticPolicy)
            return policy.get_distribution(observation)
        except KeyError as error:
            raise ValueError(
                f"{type(policy).__name__} reads {error}, which robots do not know: policies must "
                "act on what a robot observes"
            ) from error

    def _recurrent(self, policy: RecurrentActorCriticPolicy, observation: Any) -> Distribution:
        first = self._lstm_states is None
        if self._lstm_states is None:
            layers, _, width = policy.lstm_hidden_state_shape
            zeros = th.zeros(layers, self._n_rows, width, device=policy.device)
            self._lstm_states = (zeros, zeros)
        starts = th.full((self._n_rows,), float(first), device=policy.device)
        distribution, self._lstm_states = policy.get_distribution(
            observation, self._lstm_states, starts
        )
        return distribution

    def _tensor(self, array: np.ndarray, space: spaces.Space) -> th.Tensor:
        # Not obs_to_tensor: it would press maps of another size into the shape of the training.
        return th.as_tensor(maybe_transpose(np.asarray(array), space), device=self.policy.device)


@contextmanager
def _evaluating(policy: BasePolicy) -> Iterator[None]:
    """Evaluate a policy, and leave it in the mode in which it was."""
    training = policy.training
    if training:
        policy.set_training_mode(False)
    try:
        yield
    finally:
        if training:
            policy.set_training_mode(True)
