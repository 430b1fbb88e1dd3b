"""Learned policies as controllers of episodes, and the evaluations made while they learn."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from numba import njit
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.policies import BasePolicy

from area_search import paths
from area_search.random_streams import draw, episode_key, mix, to_unit
from sb3_roles.common.callbacks import role_options
from sb3_roles.common.distributions import RoleDistribution
from sb3_roles.common.names import closest
from sb3_roles.common.policies import POSITION_KEY, STATE_KEY, TeamPolicy
from sb3_roles.common.role_wrapper import ROLE_DUE_KEY, ROLE_KEY
from sb3_roles.common.roles import get_roles
from sb3_roles.common.row_policies import open_moves
from sb3_roles.common.team_wrapper import AGENT_KEY

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
    ``RoleWrapper`` handles them. When actions are drawn, the draws of a ``TeamPolicy`` are a
    function of (seed, episode, step, robot), as the map is: no global generator is used, and no
    result depends on which teams are simulated together, but for the rounding of the networks.

    :param policy: a policy, or an SB3 model
    :param role_kwargs: ``roles``, ``role_every`` and ``role_control`` as the policy was trained
        with, see ``RoleWrapper``, whose other arguments are ignored; by default those of the
        model's environment, if it has one
    :param deterministic: take the likeliest role and move instead of drawing them
    :param communicate: False switches the messages between robots off
    :raises ValueError: if an option is unknown
    """

    uses_observation: ClassVar[bool] = False
    """Read from the batch instead: rows would repeat the map of a team for each robot."""

    def __init__(
        self,
        policy: BasePolicy | BaseAlgorithm,
        role_kwargs: Mapping[str, Any] | None = None,
        deterministic: bool = True,
        communicate: bool = True,
    ) -> None:
        if role_kwargs is None:
            env = policy.env if isinstance(policy, BaseAlgorithm) else None
            role_kwargs = role_options(env)
        self.policy = policy.policy if isinstance(policy, BaseAlgorithm) else policy
        self.deterministic = deterministic
        self.communicate = communicate
        self.is_team_policy = isinstance(self.policy, TeamPolicy)
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
        self.batch: BatchedAreaSearch | None = None
        self.roles: np.ndarray | None = None
        """Int8 (n_teams, n_agents), the roles of the last step; None without roles."""

    def _set_roles(self, options: Mapping[str, Any]) -> None:
        space = self.policy.action_space
        pairs = isinstance(space, spaces.MultiDiscrete) and space.shape == (2,)
        self.n_roles = int(space.nvec[0]) if pairs else 0  # type: ignore[attr-defined]
        given = options.get("roles")
        if given is None:
            self.role_names: tuple[str, ...] = ("explore", "cover")[: self.n_roles]
            self.role_names += tuple(f"role_{k}" for k in range(2, self.n_roles))
        else:
            self.role_names = tuple(role.name for role in get_roles(given))
        if pairs and len(self.role_names) != self.n_roles:
            raise ValueError(
                f"the policy has {self.n_roles} roles, but {len(self.role_names)} are named: "
                f"{', '.join(self.role_names)}"
            )
        self.role_every = int(options.get("role_every", 1))
        self.role_control = str(options.get("role_control", "learned"))
        controls = ("learned", "random", *self.role_names)
        if pairs and self.role_control not in controls:
            raise ValueError(closest("role_control", self.role_control, controls))

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
        self._state: Any = None
        self.roles = np.full(self._shape, -1, np.int8) if self.n_roles else None

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode.

        :param batch: the teams
        :raises ValueError: if it does not observe what the policy was trained with
        """
        known = self.policy.observation_space
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
                once = self.is_team_policy
                rows[key] = value if once else np.repeat(value, batch.n_agents, axis=0)
        if not self.deterministic or self.role_control == "random":
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
            rows.update(self._role_observations(uniforms[:, 2]))
        if isinstance(self.policy, TeamPolicy):
            roles, moves = self._choose_for_teams(self.policy, rows, uniforms)
        else:
            roles, moves = self._choose_for_rows(rows)
        self._steps += 1
        if self.roles is not None:
            self._current = np.asarray(roles, np.int64)
            self.roles[:] = self._current.reshape(self._shape)
        return np.asarray(moves, np.int64)

    def _role_observations(self, uniform: np.ndarray) -> dict[str, np.ndarray]:
        due = self._steps % self.role_every == 0
        if self.role_control == "random" and due:
            self._current = (uniform * self.n_roles).astype(np.int64)
        elif self.role_control not in ("learned", "random"):
            self._current[:] = self.role_names.index(self.role_control)
        decides = np.float32(due and self.role_control == "learned")
        return {
            ROLE_KEY: (self._current[:, None] == np.arange(self.n_roles)).astype(np.float32),
            ROLE_DUE_KEY: np.full((len(self._current), 1), decides, np.float32),
        }

    def _choose_for_rows(self, rows: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Ask a policy of single robots, such as those of RecurrentPPO and MaskablePPO."""
        space, n_rows = self.policy.observation_space, len(self._members)
        known = space.spaces if isinstance(space, spaces.Dict) else None
        options: dict[str, Any] = {}
        if isinstance(self.policy, MaskableActorCriticPolicy):
            options["action_masks"] = self._masks(rows)
        try:
            actions, self._state = self.policy.predict(
                rows["observation"]
                if known is None
                else {key: rows[key] for key in known if key in rows},
                self._state,
                np.full(n_rows, self._steps == 0),
                self.deterministic,
                **options,
            )
        except KeyError as error:
            raise ValueError(
                f"{type(self.policy).__name__} reads {error}, which robots do not know: policies "
                "must act on what a robot observes"
            ) from error
        actions = actions.reshape(n_rows, -1)
        return actions[:, 0], actions[:, -1]

    def _masks(self, rows: dict[str, np.ndarray]) -> np.ndarray:
        """As ``MaskWrapper``: a role that goes on, and no blocked moves in area search."""
        parts = []
        if self.n_roles:
            parts.append((rows[ROLE_DUE_KEY] > 0.5) | (rows[ROLE_KEY] > 0.5))
        if self.batch is not None:
            parts.append(open_moves(rows["local"]))
        else:
            space = self.policy.action_space
            n = int(space.nvec[-1] if self.n_roles else space.n)  # type: ignore[attr-defined]
            parts.append(np.ones((len(self._members), n), np.bool_))
        return np.concatenate(parts, axis=1)

    def _choose_for_teams(
        self, policy: TeamPolicy, rows: dict[str, np.ndarray], uniforms: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        training, communicate = policy.training, policy.communicate
        if training:
            policy.set_training_mode(False)
        policy.communicate = self.communicate
        try:
            tensors, _ = policy.obs_to_tensor(rows)
            with th.inference_mode():
                distribution = policy.get_distribution(tensors)
        finally:
            policy.communicate = communicate
            if training:
                policy.set_training_mode(True)
        if not isinstance(distribution, RoleDistribution):
            assert isinstance(distribution, CategoricalDistribution)
            logits = distribution.distribution.logits
            moves = self._pick(logits, uniforms[:, 1])
            return moves, moves
        roles = self._pick(distribution.role_log_probs, uniforms[:, 0])
        index = th.arange(len(roles)), th.as_tensor(roles)
        return roles, self._pick(distribution.move_log_probs.cpu()[index], uniforms[:, 1])

    def _pick(self, log_probs: th.Tensor, uniform: np.ndarray) -> np.ndarray:
        """Take the likeliest entry of each row, or the one at a quantile of its distribution."""
        if self.deterministic:
            return log_probs.argmax(1).cpu().numpy()
        total = log_probs.double().exp().cumsum(1).cpu().numpy()
        chosen = (total <= uniform[:, None] * total[:, -1:]).sum(axis=1)
        return np.minimum(chosen, total.shape[1] - 1)


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
    width = (known["sub_goal"].shape or (0,))[-1]
    for name in paths.SUB_GOALS:
        if name != "none" and paths.sub_goal_width(name) == width:
            return name
    return "none"  # The key of some other environment.
