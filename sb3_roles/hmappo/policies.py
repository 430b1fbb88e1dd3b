"""The policy of HMAPPO: a role actor, a primitive actor, and a central critic for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule
from torch.nn import functional as F

from sb3_roles.common.distributions import (
    RoleDistribution,
    pick,
    role_log_probabilities,
    sample_index,
)
from sb3_roles.common.names import closest
from sb3_roles.common.policies import Observation, Streams, TeamPolicy
from sb3_roles.common.role_wrapper import ROLE_DUE_KEY, ROLE_KEY, STREAMS
from sb3_roles.common.torch_layers import GoalPrior, GraphLayer, Head, RoleHead, mlp

PRIMITIVE_INPUTS = ("own", "graph")


class RoleActorCriticPolicy(TeamPolicy):
    """p(role, move) = p(role) p(move | role), and a value for each level (Sections V-A, V-B).

    The role actor encodes its keys, mixes them by an MLP, exchanges the result with the robots that
    can communicate, and chooses a role. The primitive actor reads its own keys and the role, and
    chooses the move. The role critic and the role-conditioned primitive critic read the critic
    keys. Where a role goes on (``role_due`` of ``RoleWrapper``), its probability is 1.

    Plain PPO, A2C and TRPO can train it on the role reward (``TeamRolloutBuffer`` needed).

    :param role_arch: layers of the role actor before the graph
    :param role_head_arch: hidden layers of the role actor behind the graph
    :param primitive_keys: what the primitive actor reads; by default what the role actor reads
    :param primitive_input: ``"own"``: those keys only (the paper); ``"graph"``: the role actor's
        features behind the graph, too
    :param primitive_arch: hidden layers of the primitive actor
    :param goal_key: observation key with one row per role that begins with flags of the moves
        towards that role's sub-goal, such as area search's ``sub_goal`` (the sub-goals of the
        paper's GA-POMDP, Section IV); rows behind these belong to no role, such as the route's with
        ``sub_goal="routes"``; None for no such logits
    :param goal_prior: first weight, learned from there on, of the flags of a robot's own role in
        the moves' logits: above 0, an untrained robot heads for the sub-goal of its role
    :param other_goal_prior: the same for the flags of the other roles
    :param shared_goal_prior: the same for the flags of rows that belong to no role, with a weight
        that each role learns for itself
    :param value_arch: hidden layers of both critics
    :param see_role: give the role that is going on to the role actor and the critics; for roles
        that last several steps
    :param options: see :class:`~sb3_roles.common.policies.TeamPolicy`
    :raises ValueError: if the action space is not (role, move), or an option is unknown
    """

    stream_names: ClassVar[tuple[str, ...]] = STREAMS

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *,
        role_arch: Sequence[int] = (128, 64, 32),
        role_head_arch: Sequence[int] = (64, 32),
        primitive_keys: Sequence[str] | None = None,
        primitive_input: str = "own",
        primitive_arch: Sequence[int] = (64, 32),
        goal_key: str | None = None,
        goal_prior: float = 2.0,
        other_goal_prior: float = 1.0,
        shared_goal_prior: float = 2.0,
        value_arch: Sequence[int] = (64, 32),
        see_role: bool = False,
        **options: Any,
    ) -> None:
        pair = isinstance(action_space, spaces.MultiDiscrete) and action_space.shape == (2,)
        if (
            not pair
            or not isinstance(observation_space, spaces.Dict)
            or (ROLE_KEY not in observation_space.spaces)
        ):
            raise ValueError(
                f"RoleActorCriticPolicy acts with (role, move), got {action_space}: wrap the "
                "environment in RoleWrapper"
            )
        if primitive_input not in PRIMITIVE_INPUTS:
            raise ValueError(closest("primitive_input", primitive_input, PRIMITIVE_INPUTS))
        self.role_arch = tuple(role_arch)
        self.role_head_arch = tuple(role_head_arch)
        self.primitive_keys = None if primitive_keys is None else tuple(primitive_keys)
        self.primitive_input = primitive_input
        self.primitive_arch = tuple(primitive_arch)
        self.goal_key = goal_key
        self.goal_prior = goal_prior
        self.other_goal_prior = other_goal_prior
        self.shared_goal_prior = shared_goal_prior
        self.value_arch = tuple(value_arch)
        self.see_role = see_role
        self.n_roles, self.n_moves = (int(n) for n in action_space.nvec)  # type: ignore[attr-defined]
        super().__init__(observation_space, action_space, lr_schedule, **options)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        names = (
            "role_arch",
            "role_head_arch",
            "primitive_keys",
            "primitive_input",
            "primitive_arch",
            "goal_key",
            "goal_prior",
            "other_goal_prior",
            "shared_goal_prior",
            "value_arch",
            "see_role",
        )
        return {
            **super()._get_constructor_parameters(),
            **{name: getattr(self, name) for name in names},
        }

    def _build_networks(self) -> None:
        keys = self.actor_keys if self.primitive_keys is None else self.primitive_keys
        for key in keys:
            if key not in self.actor_keys:
                raise ValueError(closest("key in primitive_keys", key, self.actor_keys))
        self._move_keys = keys
        seen = self.n_roles if self.see_role else 0

        size = self._add_encoders("role", self.actor_keys) + seen
        self.role_mlp = mlp(size, self.role_arch)
        size = self.role_arch[-1] if self.role_arch else size
        if self.graph:
            self.role_graph = GraphLayer(size, self.graph_width)
            size = self.graph_width
        self.role_net = Head(size, self.role_head_arch, self.n_roles, gain=0.01)

        own = self._add_encoders("primitive", keys)
        own += size if self.primitive_input == "graph" else 0
        self.action_net = RoleHead(own, self.n_roles, self.primitive_arch, self.n_moves, gain=0.01)
        self.goal_net = self._make_goal_net()

        size = self._add_encoders("value_role", self.critic_keys) + seen
        self.role_value_net = Head(size, self.value_arch, 1, gain=1.0)
        size = self._add_encoders("value_primitive", self.critic_keys)
        self.value_net = RoleHead(  # type: ignore[assignment]
            size, self.n_roles, self.value_arch, 1, gain=1.0
        )
        self.action_dist = RoleDistribution()

    def _make_goal_net(self) -> GoalPrior | None:
        n_goals = self._count_goals(self.goal_key, self.n_moves)
        if not n_goals:
            return None
        if n_goals < self.n_roles:
            raise ValueError(
                f"goal_key {self.goal_key!r} must have one row for each of the {self.n_roles} "
                f"roles, got {n_goals} rows"
            )
        own = th.eye(self.n_roles)
        weights = own * self.goal_prior + (1.0 - own) * self.other_goal_prior
        shared = th.full((self.n_roles, n_goals - self.n_roles), self.shared_goal_prior)
        weights = th.cat([weights, shared], dim=1)
        return GoalPrior(weights, self.n_moves)

    def _move_log_probs(
        self, own: th.Tensor, roles: th.Tensor | None, obs: Observation
    ) -> th.Tensor:
        """Return log p(move | role), (n, n_moves) for given roles or (n, n_roles, n_moves)."""
        logits = self.action_net(own, roles)
        if self.goal_net is not None:
            logits = logits + self.goal_net(obs[self.goal_key], roles)  # type: ignore[index]
        return F.log_softmax(logits, dim=-1)

    def _with_role(self, features: th.Tensor, obs: Observation) -> th.Tensor:
        return th.cat([features, obs[ROLE_KEY]], dim=1) if self.see_role else features

    def _actor_features(
        self, obs: Observation, memo: dict[Any, th.Tensor]
    ) -> tuple[th.Tensor, th.Tensor]:
        """Return the roles' log-probabilities (n, n_roles) and the primitive actor's input."""
        n_agents = self.team_size(obs)
        features = self._with_role(self._encode("role", self.actor_keys, obs, memo), obs)
        features = self.role_mlp(features)
        if self.graph:
            graph = self._graph(obs, features, n_agents)
            teams = features.view(-1, n_agents, features.shape[1])
            features = self.role_graph(teams, graph).flatten(0, 1)
        logits = self.role_net(features)
        role_log_probs = role_log_probabilities(
            logits, obs[ROLE_KEY], obs[ROLE_DUE_KEY][:, 0] > 0.5
        )
        own = self._encode("primitive", self._move_keys, obs, memo)
        if self.primitive_input == "graph":
            own = th.cat([own, features], dim=1)
        return role_log_probs, own

    def _role_values(self, obs: Observation, memo: dict[Any, th.Tensor]) -> th.Tensor:
        features = self._encode("value_role", self.critic_keys, obs, memo)
        return self.role_value_net(self._with_role(features, obs))

    def streams(
        self,
        obs: Observation,
        actions: th.Tensor | None = None,
        deterministic: bool = False,
        generator: th.Generator | None = None,
    ) -> Streams:
        """Evaluate both actors and both critics, see :meth:`TeamPolicy.streams`.

        The primitive value to bootstrap with is the expectation over roles: the role of the next
        step is not chosen yet.
        """
        memo: dict[Any, th.Tensor] = {}
        choose = actions is None

        def chosen(log_probs: th.Tensor) -> th.Tensor:
            return log_probs.argmax(1) if deterministic else sample_index(log_probs, generator)

        role_log_probs, own = self._actor_features(obs, memo)
        roles = chosen(role_log_probs) if actions is None else actions[:, 0]
        move_log_probs = self._move_log_probs(own, roles, obs)
        role_values = self._role_values(obs, memo)
        critic = self._encode("value_primitive", self.critic_keys, obs, memo)
        move_values = self.value_net(critic, None if choose else roles)
        if actions is None:
            actions = th.stack([roles, chosen(move_log_probs)], dim=1)
        expected = move_values
        if choose:
            by_role = move_values.squeeze(2)
            expected = (role_log_probs.exp() * by_role).sum(1, keepdim=True)
            move_values = pick(by_role, roles).unsqueeze(1)
        active = th.ones_like(actions, dtype=th.bool)
        active[:, 0] = obs[ROLE_DUE_KEY][:, 0] > 0.5
        return Streams(
            actions,
            (role_log_probs, move_log_probs),
            th.cat([role_values, move_values], dim=1),
            th.cat([role_values, expected], dim=1),
            active,
        )

    def get_distribution(self, obs: th.Tensor | Observation) -> RoleDistribution:
        """Return the joint distribution over role and move of whole teams."""
        role_log_probs, own = self._actor_features(obs, {})  # type: ignore[arg-type]
        move_log_probs = self._move_log_probs(own, None, obs)  # type: ignore[arg-type]
        return RoleDistribution().proba_distribution(role_log_probs, move_log_probs)

    def predict_values(self, obs: th.Tensor | Observation) -> th.Tensor:
        """Return the role values of any rows, float (n, 1)."""
        return self._role_values(obs, {})  # type: ignore[arg-type]
