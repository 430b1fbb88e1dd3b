"""``RoleWrapper``: the hierarchy as an environment whose actions are (role, primitive action)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from sb3_roles.common import roles as role_registry
from sb3_roles.common.checks import check_positive
from sb3_roles.common.names import closest
from sb3_roles.common.role_rules import NearestRole
from sb3_roles.common.roles import (
    LEARNED,
    NEAREST,
    RANDOM,
    Role,
    get_roles,
    role_controls,
    weight_vector,
)
from sb3_roles.common.team_vec_env import team_seeds
from sb3_roles.common.team_wrapper import TeamWrapper

ROLE_KEY = "role"
ROLE_DUE_KEY = "role_due"
REWARD_SHARING = ("own", "same_role", "team")
STREAMS = ("role", "primitive")


class RoleWrapper(TeamWrapper):
    """Actions ``MultiDiscrete([n_roles, n_primitives])``, and a reward for each of the two levels.

    The base environment gets the primitive action and knows nothing of roles. The reward of a row
    is the role reward, R = alpha R_e + beta R_c for area search (Eq. 2); ``stream_rewards``,
    float32 (num_envs, 2), holds the role reward and the primitive reward (Eq. 6) of the last step.

    Observations get two more keys: ``role``, float32 (n_roles,), the role of the last step as a
    one-hot (all 0 at the start of an episode), and ``role_due``, float32 (1,): 1 when the role
    policy decides in this step, 0 when the role in ``role`` goes on. The role policy decides every
    ``role_every`` steps of an episode. A controlled role (fixed, random or by a rule) is never due:
    ``role`` is that of the coming step, also in the last observation of an episode, in which the
    value of going on is asked for.

    :param venv: an environment of ``make_team_vec_env``, possibly wrapped, with discrete actions
    :param roles: names of the role registry, or roles
    :param role_weights: weights of the reward components in the role reward; by default 1 for each
    :param primitive_weights: ``"identity"`` (the paper), ``"role_reward"`` (the released code), or
        for each role the weights by component
    :param reward_sharing: whose components a robot is paid: ``"own"``, those of the robots that act
        in its role (``"same_role"``, the paper), or of the whole ``"team"``
    :param role_every: steps that a role lasts
    :param role_control: ``"learned"``, ``"random"`` (uniform, every ``role_every`` steps),
        ``"nearest"`` (the role whose goal is nearest, or nearest of those assigned to the robot
        unless ``sub_goal="nearest"``, every ``role_every`` steps, see ``NearestRole``) or the name
        of the role that all robots act in. Random roles are a function of the seed of ``seed()``,
        the team, and the numbers of episode and step
    :raises ValueError: if an option is unknown or out of range, the actions are not discrete, or
        the environment does not observe what ``"nearest"`` needs
    """

    def __init__(
        self,
        venv: VecEnv,
        roles: Sequence[str | Role] = ("explore", "cover"),
        role_weights: Mapping[str, float] | None = None,
        primitive_weights: str | Mapping[str, Mapping[str, float]] = "identity",
        reward_sharing: str = "own",
        role_every: int = 1,
        role_control: str = LEARNED,
    ) -> None:
        self.roles = get_roles(roles)
        self.role_names = tuple(role.name for role in self.roles)
        if reward_sharing not in REWARD_SHARING:
            raise ValueError(closest("reward_sharing", reward_sharing, REWARD_SHARING))
        check_positive(role_every=role_every)
        controls = role_controls(self.role_names)
        if role_control not in controls:
            raise ValueError(closest("role_control", role_control, controls))
        if not isinstance(venv.action_space, spaces.Discrete):
            raise ValueError(f"roles need discrete actions, got {venv.action_space}")
        super().__init__(venv)
        self.action_space = spaces.MultiDiscrete([len(self.roles), int(venv.action_space.n)])
        # An environment without components has one: its reward, which every role is paid.
        self.components = self.team_env.component_names or ("reward",)
        if not self.team_env.component_names:
            self.roles = tuple(Role(role.name, "reward", role.goal_set) for role in self.roles)
        by_role = dict.fromkeys(self.components, 1.0) if role_weights is None else role_weights
        self._role_weights = weight_vector("role_weights", by_role, self.components)
        self._primitive_weights = role_registry.primitive_weights(
            primitive_weights, self.roles, self.components, self._role_weights
        )
        self.reward_sharing = reward_sharing
        self.role_every = role_every
        self.role_control = role_control
        nearest = role_control == NEAREST
        self._rule = NearestRole(self.roles, self.team_env.goal_nearness) if nearest else None
        pending = [seed for seed in self.team_env._seeds[:: self.n_agents] if seed is not None]
        seeds = pending or team_seeds(0, self.n_teams)
        self._role_seeds = np.array(seeds, np.uint64)
        self._episodes = np.zeros(self.n_teams, np.uint64)
        self.current_roles = np.full(self.num_envs, -1, np.int64)
        self._episode_steps = np.zeros(self.num_envs, np.int64)
        self.stream_rewards = np.zeros((self.num_envs, len(STREAMS)), np.float32)

    def _extra_spaces(self) -> dict[str, spaces.Space]:
        return {
            ROLE_KEY: spaces.Box(0.0, 1.0, (len(self.roles),), np.float32),
            ROLE_DUE_KEY: spaces.Box(0.0, 1.0, (1,), np.float32),
        }

    def _extra_observations(self) -> dict[str, np.ndarray]:
        due = self._decides()
        if self.role_control != LEARNED:
            due = np.zeros_like(due)
        one_hot = self.current_roles[:, None] == np.arange(len(self.roles))
        return {
            ROLE_KEY: one_hot.astype(np.float32),
            ROLE_DUE_KEY: due[:, None].astype(np.float32),
        }

    def _decides(self) -> np.ndarray:
        """Bool (num_envs,): whether a role is chosen in the coming step."""
        return self._episode_steps % self.role_every == 0

    def _control_roles(self, observations: Any) -> None:
        """Set the roles that are not learned, for the coming step.

        :param observations: what the robots see, of the environment
        """
        if self.role_control == LEARNED:
            return
        if self.role_control == RANDOM:
            self.current_roles = np.where(self._decides(), self._random_roles(), self.current_roles)
        elif self._rule is not None:
            self.current_roles = np.where(
                self._decides(), self._rule(observations), self.current_roles
            )
        else:
            self.current_roles[:] = self.role_names.index(self.role_control)

    def _extend_terminal(self, infos: list[dict[str, Any]]) -> None:
        """Extend them, with the role that each robot would have next.

        Its row has no role any more afterwards: ``step_wait`` begins a new episode.
        """
        last = {
            row: info["terminal_observation"]
            for row, info in enumerate(infos)
            if "terminal_observation" in info
        }
        if last and self.role_control in (RANDOM, NEAREST):
            rows = np.fromiter(last, np.int64)
            rows = rows[self._decides()[rows]]
            if self._rule is None:
                self.current_roles[rows] = self._random_roles()[rows]
            elif len(rows):
                keys = self._rule.keys
                seen = {key: np.stack([last[row][key] for row in rows]) for key in keys}
                self.current_roles[rows] = self._rule(seen)
        super()._extend_terminal(infos)

    def _random_roles(self) -> np.ndarray:
        """Roles of the coming step, hashed from (seed of the team, episode, step, robot)."""
        seeds = np.repeat(self._role_seeds, self.n_agents)
        episodes = np.repeat(self._episodes, self.n_agents)
        robots = np.tile(np.arange(self.n_agents, dtype=np.uint64), self.n_teams)
        word = seeds
        for part in (episodes, self._episode_steps.astype(np.uint64), robots):
            # SplitMix64's scrambling, after each part.
            word = word + (part + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
            word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
            word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
            word = word ^ (word >> np.uint64(31))
        return (word % np.uint64(len(self.roles))).astype(np.int64)

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Set the seeds of the environments, and of random roles, for the next ``reset()``.

        :param seed: the seed of the whole set, None for fresh entropy
        :return: the team's seed for each row
        """
        per_row = self.venv.seed(seed)
        self._role_seeds = np.array(per_row[:: self.n_agents], np.uint64)
        self._episodes[:] = 0
        return per_row

    def reset(self) -> dict[str, np.ndarray]:
        """Start new episodes, without a role yet.

        :return: observations, rows (n_teams * n_agents, ...)
        """
        self.current_roles = np.full(self.num_envs, -1, np.int64)
        self._episodes += np.uint64(1)
        self._episode_steps[:] = 0
        self.stream_rewards = np.zeros_like(self.stream_rewards)
        observations = self.venv.reset()
        self._control_roles(observations)
        return self._extend(observations)

    def step_async(self, actions: np.ndarray) -> None:
        """Hand the primitive actions to the environment.

        :param actions: integer (num_envs, 2), role and primitive action of each row
        :raises ValueError: if the shape is wrong, or a role is not the one that goes on
        """
        actions = np.asarray(actions)
        if actions.shape != (self.num_envs, 2):
            raise ValueError(
                f"actions must have shape ({self.num_envs}, 2): role and primitive action of each "
                f"row, got {actions.shape}"
            )
        roles = actions[:, 0].astype(np.int64)
        if roles.min() < 0 or roles.max() >= len(self.roles):
            wrong = roles[(roles < 0) | (roles >= len(self.roles))][0]
            raise ValueError(
                f"roles must be in 0..{len(self.roles) - 1} ({', '.join(self.role_names)}), "
                f"got {wrong}"
            )
        held = self._extra_observations()[ROLE_DUE_KEY][:, 0] == 0
        if np.any(held & (roles != self.current_roles)):
            row = int(np.flatnonzero(held & (roles != self.current_roles))[0])
            raise ValueError(
                f"row {row} acts in role {roles[row]}, but its role {self.current_roles[row]} goes "
                "on: where role_due is 0 a policy must keep the role of the observation"
            )
        self.current_roles = roles
        self.venv.step_async(actions[:, 1])

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step.

        :return: observations, role rewards float32 (num_envs,), dones, infos
        """
        observations, rewards, dones, infos = self.venv.step_wait()
        components = (
            self.team_env.reward_components if self.team_env.component_names else rewards[:, None]
        )
        shared = self._share(components)
        weights = self._primitive_weights[self.current_roles]
        self.stream_rewards = np.stack(
            [shared @ self._role_weights, (shared * weights).sum(axis=1)], axis=1
        ).astype(np.float32)
        self._episode_steps += 1
        self._extend_terminal(infos)
        self._episode_steps[dones] = 0
        self._episodes[dones[:: self.n_agents]] += np.uint64(1)
        self.current_roles = np.where(dones, -1, self.current_roles)
        self._control_roles(observations)
        return self._extend(observations), self.stream_rewards[:, 0].copy(), dones, infos

    def _share(self, components: np.ndarray) -> np.ndarray:
        """Sum each row's components over the robots whose reward it shares.

        :param components: float32 (num_envs, n_components)
        :return: float32, the same shape
        """
        if self.reward_sharing == "own":
            return components
        team = components.reshape(self.n_teams, self.n_agents, -1)
        if self.reward_sharing == "team":
            shared = np.broadcast_to(team.sum(axis=1, keepdims=True), team.shape)
        else:
            member = self.current_roles.reshape(self.n_teams, self.n_agents)
            one_hot = (member[:, :, None] == np.arange(len(self.roles))).astype(np.float32)
            by_role = np.einsum("tar,tac->trc", one_hot, team)
            shared = np.einsum("tar,trc->tac", one_hot, by_role)
        return shared.reshape(components.shape)

    def get_state(self) -> dict[str, Any]:
        """Return what the coming steps depend on, apart from the environment's own state."""
        return {
            "current_roles": self.current_roles.copy(),
            "episode_steps": self._episode_steps.copy(),
            "episodes": self._episodes.copy(),
            "role_seeds": self._role_seeds.copy(),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned."""
        self.current_roles = np.array(state["current_roles"], np.int64)
        self._episode_steps[:] = state["episode_steps"]
        self._episodes[:] = state["episodes"]
        self._role_seeds[:] = state["role_seeds"]


def role_wrapper_of(env: VecEnv | None) -> RoleWrapper | None:
    """Return the ``RoleWrapper`` among the layers of an environment, if there is one."""
    layer: Any = env
    while isinstance(layer, VecEnvWrapper):
        if isinstance(layer, RoleWrapper):
            return layer
        layer = layer.venv
    return None
