"""The policy of MAPPO: one actor with a graph, one critic."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.type_aliases import Schedule
from torch.nn import functional as F

from sb3_roles.common.distributions import sample_index
from sb3_roles.common.policies import Observation, Streams, TeamPolicy
from sb3_roles.common.torch_layers import GoalPrior, GraphLayer, Head, mlp


class TeamActorCriticPolicy(TeamPolicy):
    """A move from what a robot sees and hears; a value from the state (CTDE).

    The actor encodes its keys, mixes them by an MLP, exchanges the result with the robots that can
    communicate, and maps it to logits: the form of ECC's network (Blumenkamp and Prorok, 2020).

    :param actor_arch: layers before the graph
    :param head_arch: hidden layers behind the graph
    :param value_arch: hidden layers of the critic
    :param goal_key: observation key whose rows begin with flags of the moves towards a sub-goal,
        such as area search's ``sub_goal``; None for no such logits
    :param goal_prior: first weight, learned from there on, of these flags in the moves' logits:
        above 0, an untrained robot heads for its sub-goals, most where one move serves several; one
        number for all rows or one for each
    :param options: see :class:`~sb3_roles.common.policies.TeamPolicy`
    :raises ValueError: if the action space is not discrete, or an option is unknown
    """

    stream_names: ClassVar[tuple[str, ...]] = ("primitive",)

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *,
        actor_arch: Sequence[int] = (128, 64),
        head_arch: Sequence[int] = (64, 32),
        value_arch: Sequence[int] = (64, 32),
        goal_key: str | None = None,
        goal_prior: float | Sequence[float] = 2.0,
        **options: Any,
    ) -> None:
        if not isinstance(action_space, spaces.Discrete):
            raise ValueError(f"MAPPO needs discrete actions, got {action_space}")
        self.actor_arch = tuple(actor_arch)
        self.head_arch = tuple(head_arch)
        self.value_arch = tuple(value_arch)
        self.goal_key = goal_key
        self.goal_prior = goal_prior
        super().__init__(observation_space, action_space, lr_schedule, **options)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = ("actor_arch", "head_arch", "value_arch", "goal_key", "goal_prior")
        return {
            **super()._get_constructor_parameters(),
            **{name: getattr(self, name) for name in names},
        }

    def _build_networks(self) -> None:
        assert isinstance(self.action_space, spaces.Discrete)
        size = self._add_encoders("primitive", self.actor_keys)
        self.actor_mlp = mlp(size, self.actor_arch)
        size = self.actor_arch[-1] if self.actor_arch else size
        if self.graph:
            self.actor_graph = GraphLayer(size, self.graph_width)
            size = self.graph_width
        n_moves = int(self.action_space.n)
        self.action_net = Head(size, self.head_arch, n_moves, gain=0.01)
        n_goals = self._count_goals(self.goal_key, n_moves)
        self.goal_net = self._make_goal_net(n_goals, n_moves)
        size = self._add_encoders("value_primitive", self.critic_keys)
        self.value_net = Head(size, self.value_arch, 1, gain=1.0)  # type: ignore[assignment]
        self.action_dist = CategoricalDistribution(n_moves)

    def _make_goal_net(self, n_goals: int, n_moves: int) -> GoalPrior | None:
        if not n_goals:
            return None
        prior = th.tensor(self.goal_prior, dtype=th.float32)
        if prior.ndim and prior.shape != (n_goals,):
            raise ValueError(
                f"goal_prior must be one number or one for each of the {n_goals} rows of "
                f"{self.goal_key!r}, got {self.goal_prior!r}"
            )
        return GoalPrior(prior.expand(n_goals).clone(), n_moves)

    def _log_probs(self, obs: Observation, memo: dict[Any, th.Tensor]) -> th.Tensor:
        n_agents = self.team_size(obs)
        features = self.actor_mlp(self._encode("primitive", self.actor_keys, obs, memo))
        if self.graph:
            graph = self._graph(obs, features, n_agents)
            teams = features.view(-1, n_agents, features.shape[1])
            features = self.actor_graph(teams, graph).flatten(0, 1)
        logits = self.action_net(features)
        if self.goal_net is not None:
            logits = logits + self.goal_net(obs[self.goal_key])  # type: ignore[index]
        return F.log_softmax(logits, dim=1)

    def _values(self, obs: Observation, memo: dict[Any, th.Tensor]) -> th.Tensor:
        return self.value_net(self._encode("value_primitive", self.critic_keys, obs, memo))

    def streams(
        self,
        obs: Observation,
        actions: th.Tensor | None = None,
        deterministic: bool = False,
        generator: th.Generator | None = None,
    ) -> Streams:
        """Evaluate the actor and the critic, see :meth:`TeamPolicy.streams`."""
        memo: dict[Any, th.Tensor] = {}
        log_probs = self._log_probs(obs, memo)
        values = self._values(obs, memo)
        if actions is None:
            chosen = log_probs.argmax(1) if deterministic else sample_index(log_probs, generator)
            actions = chosen.unsqueeze(1)
        active = th.ones_like(actions, dtype=th.bool)
        return Streams(actions, (log_probs,), values, values, active)

    def get_distribution(self, obs: th.Tensor | Observation) -> CategoricalDistribution:
        """Return the distribution over moves of whole teams."""
        log_probs = self._log_probs(obs, {})  # type: ignore[arg-type]
        return CategoricalDistribution(log_probs.shape[1]).proba_distribution(log_probs)

    def predict_values(self, obs: th.Tensor | Observation) -> th.Tensor:
        """Return the values of any rows, float (n, 1)."""
        return self._values(obs, {})  # type: ignore[arg-type]
