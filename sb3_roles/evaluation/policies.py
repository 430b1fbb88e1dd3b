"""Learned policies as controllers of episodes."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from numba import njit
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy

from area_search import paths
from area_search.random_streams import draw, episode_key, mix, to_unit
from sb3_roles.common.actor_weights import actor_weights
from sb3_roles.common.callbacks import role_options
from sb3_roles.common.env_declarations import GoalNearness
from sb3_roles.common.names import closest
from sb3_roles.common.policies import POSITION_KEY, STATE_KEY, TeamPolicy
from sb3_roles.common.role_rules import NearestRole
from sb3_roles.common.role_wrapper import ROLE_DUE_KEY, ROLE_KEY
from sb3_roles.common.roles import (
    LEARNED,
    NEAREST,
    RANDOM,
    Role,
    get_roles,
    role_controls,
)
from sb3_roles.common.team_wrapper import AGENT_KEY, find_team_env
from sb3_roles.evaluation.choices import ActionChooser

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch
    from sb3_roles.baselines.base import States

# Separates these draws from those of the map, which have the same seed and episode.
_TAG = np.uint64(0x504F4C4943592121)  # "POLICY!!"
_N_UNIFORMS = 3


class PolicyController:
    """A learned policy as a controller of ``run_episodes``, for teams and maps of any size.

    Observations are built from the arrays of the simulation: what a team shares is encoded once,
    and the policy is never given ``state``, which only critics may read. Roles are handled as
    ``RoleWrapper`` handles them. When actions are drawn, the draws are a function of (seed,
    episode, step, robot), as the map is: no global generator is used, and no result depends on
    which teams are simulated together, but for the rounding of the networks.

    :param policy: an actor-critic policy with discrete actions, or an SB3 model with such a one
    :param role_kwargs: ``roles``, ``role_every`` and ``role_control`` as the policy was trained
        with, see ``RoleWrapper``, whose other arguments are ignored; by default those of the
        model's environment, if it has one
    :param deterministic: take the likeliest role and move instead of drawing them
    :param communicate: False switches the messages between robots off; the attribute is None for a
        policy without any: one of single robots, or of teams without the graph layer
    :raises ValueError: if an option is unknown, the policy is none that can be played, or it has no
        messages to switch off
    """

    def __init__(
        self,
        policy: BasePolicy | BaseAlgorithm,
        role_kwargs: Mapping[str, Any] | None = None,
        deterministic: bool = True,
        communicate: bool = True,
    ) -> None:
        env = policy.env if isinstance(policy, BaseAlgorithm) else None
        if role_kwargs is None:
            role_kwargs = role_options(env)
        self.policy = policy.policy if isinstance(policy, BaseAlgorithm) else policy
        self.deterministic = deterministic
        self._chooser = ActionChooser(self.policy, communicate)
        messages = isinstance(self.policy, TeamPolicy) and self.policy.graph
        if not (messages or communicate):
            raise ValueError("its robots exchange no messages that could be switched off")
        self.communicate = communicate if messages else None
        space = self.policy.observation_space
        known = space.spaces if isinstance(space, spaces.Dict) else {}
        extra = (AGENT_KEY, ROLE_KEY, ROLE_DUE_KEY, STATE_KEY)
        self.keys = tuple(key for key in known if key not in extra)
        if isinstance(self.policy, TeamPolicy):
            # What only critics read needs no observation.
            needed = (*self.policy.actor_keys, POSITION_KEY)
            self.keys = tuple(key for key in self.keys if key in needed)
        self.sub_goal = _sub_goal_of(known)
        self._set_roles(role_kwargs)
        self._rule: NearestRole | None = None
        if env is not None and self.role_control == NEAREST:
            self._set_rule(find_team_env(env).goal_nearness)
        self.batch: BatchedAreaSearch | None = None
        self.roles: np.ndarray | None = None
        """Int8 (n_teams, n_agents), the roles of the last step; None without roles."""

    def _set_roles(self, options: Mapping[str, Any]) -> None:
        space = self.policy.action_space
        pairs = isinstance(space, spaces.MultiDiscrete) and space.shape == (2,)
        self.n_roles = int(space.nvec[0]) if pairs else 0  # type: ignore[attr-defined]
        given = options.get("roles")
        if given is None:
            unnamed = tuple(Role(f"role_{k}", "") for k in range(2, self.n_roles))
            self._roles = (*get_roles(("explore", "cover"))[: self.n_roles], *unnamed)
        else:
            self._roles = get_roles(given)
        self.role_names = tuple(role.name for role in self._roles)
        if pairs and len(self.role_names) != self.n_roles:
            raise ValueError(
                f"the policy has {self.n_roles} roles, but {len(self.role_names)} are named: "
                f"{', '.join(self.role_names)}"
            )
        self.role_every = int(options.get("role_every", 1))
        self.role_control = str(options.get("role_control", LEARNED)) if pairs else LEARNED
        controls = role_controls(self.role_names)
        if self.role_control not in controls:
            raise ValueError(closest("role_control", self.role_control, controls))

    def _set_rule(self, goal_nearness: GoalNearness) -> None:
        self._rule = NearestRole(self._roles, goal_nearness)
        self.keys += tuple(key for key in self._rule.keys if key not in self.keys)

    @property
    def description(self) -> dict[str, Any]:
        """What tells this controller from others, JSON values, for records."""
        digest = hashlib.sha256()
        # Critics decide about nothing that is played, and files to act with lack them.
        for name, value in actor_weights(self.policy).items():
            digest.update(name.encode())
            flat = value.detach().cpu().contiguous().reshape(-1)
            digest.update(flat.view(th.uint8).numpy().tobytes())
        return {
            "policy": type(self.policy).__name__,
            "weights": digest.hexdigest(),
            "sub_goal": self.sub_goal,
            "roles": list(self.role_names),
            "role_every": self.role_every,
            "role_control": self.role_control,
        }

    def start(self, n_teams: int, n_agents: int) -> None:
        """Begin an episode in every team.

        :param n_teams: number of teams
        :param n_agents: robots in each
        """
        self._shape = (n_teams, n_agents)
        index = np.arange(n_agents, dtype=np.float32)
        self._members = np.tile(
            np.stack([index, np.full_like(index, n_agents)], axis=1), (n_teams, 1)
        )
        self._current = np.full(n_teams * n_agents, -1, np.int64)
        self._steps = 0
        self._chooser.start(n_teams * n_agents, blocked_moves=self.batch is not None)
        self.roles = np.full(self._shape, -1, np.int8) if self.n_roles else None

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode.

        :param batch: the teams
        :raises ValueError: if it does not observe what the policy was trained with
        """
        known = self.policy.observation_space
        if self.role_control == NEAREST:
            self._set_rule(batch.goal_nearness)
        if "known" in self.keys:
            batch.show_known_map()
        if "time" in self.keys:
            batch.show_time()
        for key in self.keys:
            if key not in batch.observations:
                raise ValueError(
                    f"the policy reads {key!r}, which area search with sub_goal="
                    f"{batch.sub_goal!r} does not observe: this policy needs {self.sub_goal!r}"
                )
            want = known[key].shape or ()  # type: ignore[index]
            have = batch.observation_space[key].shape or ()
            # Maps of any size can be encoded.
            if want != have and not (len(want) == len(have) == 3 and want[:1] == have[:1]):
                raise ValueError(f"the policy was trained with {key!r} of shape {want}, not {have}")
        self.batch = batch
        self._uniforms = np.zeros((batch.n_teams, batch.n_agents, _N_UNIFORMS))
        self.start(batch.n_teams, batch.n_agents)

    def predict(
        self,
        observation: dict[str, np.ndarray],
        state: States | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, States | None]:
        """Choose a move for each row, see ``Controller``; the arguments are ignored.

        :return: int64 (n_teams * n_agents,), and ``state``
        :raises RuntimeError: if :meth:`begin` was not called
        """
        batch = self.batch
        if batch is None:
            raise RuntimeError("PolicyController reads the teams: call begin(batch) first")
        rows = {}
        for key in self.keys:
            value = batch.observations[key]
            if key not in batch.team_observation_keys:
                rows[key] = value.reshape(-1, *value.shape[2:])
            else:
                once = isinstance(self.policy, TeamPolicy)
                rows[key] = value if once else np.repeat(value, batch.n_agents, axis=0)
        if not self.deterministic or self.role_control == RANDOM:
            _draw_uniforms(batch.keys, batch.episodes, batch.steps, self._uniforms)
        return self.choose(rows, self._uniforms.reshape(-1, _N_UNIFORMS)), state

    def choose(self, observation: Mapping[str, np.ndarray], uniforms: np.ndarray) -> np.ndarray:
        """Choose a move for each row, and let one step pass.

        :param observation: key -> (rows, ...); of what a team shares (n_teams, ...) will do
        :param uniforms: float (rows, 3) in [0, 1), from which role, move and random role are drawn
        :return: int64 (rows,)
        """
        rows = {**observation, AGENT_KEY: self._members}
        if self.n_roles:
            rows.update(self._role_observations(rows, uniforms[:, 2]))
        draws = None if self.deterministic else uniforms[:, :2]
        roles, moves = self._chooser.choose(rows, draws)
        self._steps += 1
        if self.roles is not None:
            self._current = np.asarray(roles, np.int64)
            self.roles[:] = self._current.reshape(self._shape)
        return np.asarray(moves, np.int64)

    def _role_observations(
        self, rows: Mapping[str, np.ndarray], uniform: np.ndarray
    ) -> dict[str, np.ndarray]:
        due = self._steps % self.role_every == 0
        if self.role_control == RANDOM and due:
            self._current = (uniform * self.n_roles).astype(np.int64)
        elif self.role_control == NEAREST and due:
            if self._rule is None:
                raise RuntimeError("role_control='nearest' needs the teams: call begin(batch)")
            self._current = self._rule(rows)
        elif self.role_control in self.role_names:
            self._current[:] = self.role_names.index(self.role_control)
        decides = np.float32(due and self.role_control == LEARNED)
        return {
            ROLE_KEY: (self._current[:, None] == np.arange(self.n_roles)).astype(np.float32),
            ROLE_DUE_KEY: np.full((len(self._current), 1), decides, np.float32),
        }


@njit(cache=True)
def _draw_uniforms(
    keys: np.ndarray, episodes: np.ndarray, steps: np.ndarray, uniforms: np.ndarray
) -> None:
    n_agents, n_draws = uniforms.shape[1:]
    for m in range(uniforms.shape[0]):
        first = mix(keys[m, 0] ^ _TAG)
        second = mix(episode_key(keys[m], episodes[m]) ^ _TAG)
        for i in range(n_agents):
            begin = (np.uint64(steps[m]) * np.uint64(n_agents) + np.uint64(i)) * np.uint64(n_draws)
            for k in range(n_draws):
                uniforms[m, i, k] = to_unit(draw(first, second, begin + np.uint64(k)))


def _sub_goal_of(known: Mapping[str, spaces.Space]) -> str:
    if "sub_goal" not in known:
        return "none"
    for name in paths.SUB_GOALS:
        if name != "none" and paths.sub_goal_shape(name) == known["sub_goal"].shape:
            return name
    return "none"  # The key of some other environment.
