"""What several test modules share: hand-made maps and episodes, small policies and models."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from area_search import AreaSearchEnv, BatchedAreaSearch, Scene, kernels
from area_search import cells as layout
from sb3_roles.common.policies import TeamPolicy
from sb3_roles.common.role_wrapper import RoleWrapper
from sb3_roles.common.team_vec_env import make_team_vec_env
from sb3_roles.common.torch_layers import Head
from sb3_roles.hmappo.policies import RoleActorCriticPolicy
from sb3_roles.mappo.policies import TeamActorCriticPolicy
from sb3_roles.prove.search_maps import boards as boards
from sb3_roles.prove.search_maps import has as has

# Neighbors in the order of the actions up, right, down, left.
STEPS = ((-1, 0), (0, 1), (1, 0), (0, -1))
STOP, UP, RIGHT, DOWN, LEFT = range(5)

# What one character of a hand-made map stands for; digits are robots on explored free cells.
_EXPLORED_OBSTACLE = layout.EXPLORED | layout.OBSTACLE | layout.KNOWN_OBSTACLE
SYMBOLS = {
    "#": _EXPLORED_OBSTACLE,
    ".": layout.EXPLORED,
    "?": 0,
    "%": layout.OBSTACLE,
    "T": layout.EXPLORED | layout.TARGET | layout.KNOWN_TARGET,
    "t": layout.TARGET,
    "c": layout.EXPLORED | layout.COVERED,
}


def hand_made(
    rows: Sequence[str],
    robots: Sequence[tuple[int, int]] | None = None,
    sub_goal: str = "none",
    **options: Any,
) -> BatchedAreaSearch:
    """One team on a map drawn with ``SYMBOLS``; smaller maps are filled up to 5 x 5 with ``#``.

    :param rows: the map; digits 0, 1, ... place the robots of that index
    :param robots: positions by index, instead of digits
    """
    height, width = max(5, len(rows)), max(5, len(rows[0]))
    rows = [row.ljust(width, "#") for row in rows] + ["#" * width] * (height - len(rows))
    if robots is None:
        drawn = {c: (y, x) for y, row in enumerate(rows) for x, c in enumerate(row) if c.isdigit()}
        robots = [drawn[str(i)] for i in range(len(drawn))]
    board = np.array(
        [[layout.EXPLORED if c.isdigit() else SYMBOLS[c] for c in row] for row in rows], np.uint8
    )
    free = board & layout.OBSTACLE == 0
    targets = board & (layout.TARGET | layout.COVERED) > 0
    scene = Scene(
        name="hand-made",
        height=height,
        width=width,
        free_fraction=float(free.mean()),
        n_targets=max(1, int(targets.sum())),
        n_agents=len(robots),
    ).with_options(**options)
    batch = BatchedAreaSearch(scene, 1, sub_goal)
    batch.reset(0)
    state = batch.get_state()
    for row, column in robots:
        assert board[row, column] & layout.OBSTACLE == 0
        board[row, column] |= layout.ROBOT
    border = (state["cells"].shape[1] - height) // 2
    state["cells"][:] = _EXPLORED_OBSTACLE
    state["cells"][0, border:-border, border:-border] = board
    state["position"][0] = robots
    state["totals"][0, kernels.SEEN_FREE] = np.sum(free & (board & layout.EXPLORED > 0))
    batch.set_state(state)
    return batch


def reachable(free: np.ndarray) -> int:
    """Count the free cells that 4-neighbor moves reach from the first one."""
    start = tuple(int(n) for n in np.argwhere(free)[0])
    found, queue = {start}, deque([start])
    while queue:
        row, column = queue.popleft()
        for dy, dx in STEPS:
            cell = (row + dy, column + dx)
            inside = 0 <= cell[0] < free.shape[0] and 0 <= cell[1] < free.shape[1]
            if inside and cell not in found and free[cell]:
                found.add(cell)
                queue.append(cell)
    return len(found)


def episode_actions(scene: Scene, seed: int, episode: int) -> np.ndarray:
    """Return an episode's actions, (horizon, n_agents), the same wherever it is played."""
    rng = np.random.default_rng([77, seed, episode])
    return rng.integers(0, 5, (scene.horizon, scene.n_agents))


def visible(batch: BatchedAreaSearch, team: int, reset: bool = False) -> dict[str, Any]:
    """Copy all that a user can see of a team; after a reset, only what belongs to the episode."""
    seen = {key: value[team].copy() for key, value in batch.observations.items()}
    if not reset:
        for name in ("rewards", "reward_components", "terminated", "truncated"):
            seen[name] = getattr(batch, name)[team].copy()
        seen |= batch.episode_metrics(team)
    return seen


def play_episode(
    batch: BatchedAreaSearch, team: int, actions: np.ndarray
) -> Iterator[dict[str, Any]]:
    """Play one team of a batch to the end of the actions; the others stand still."""
    yield visible(batch, team, reset=True)
    for moves in actions:
        everyone = np.zeros((batch.n_teams, batch.n_agents), np.int64)
        everyone[team] = moves
        batch.step(everyone)
        yield visible(batch, team)


def lone_episode(
    scene: Scene, seed: int, episode: int, sub_goal: str = "none"
) -> list[dict[str, Any]]:
    """Record an episode that is played in a batch of one."""
    batch = BatchedAreaSearch(scene, 1, sub_goal)
    batch.reset([seed], [episode])
    return list(play_episode(batch, 0, episode_actions(scene, seed, episode)))


def one_line(error: BaseException) -> str:
    """Return the message of an error, which must be a single line."""
    message = str(error)
    assert message
    assert "\n" not in message
    return message


# Learning: small networks, policies that are not nearly uniform, short rollouts.

SMALL = {
    "local_channels": (4, 4, 8),
    "joint_channels": (4, 4, 8, 8),
    "state_channels": (4, 4, 8),
    "graph_width": 16,
    "value_arch": (16,),
}
SMALL_ROLE = {**SMALL, "role_arch": (16,), "role_head_arch": (16,), "primitive_arch": (16,)}
SMALL_TEAM = {**SMALL, "actor_arch": (16,), "head_arch": (16,)}
POLICIES = {
    "mappo": (TeamActorCriticPolicy, SMALL_TEAM),
    "hmappo": (RoleActorCriticPolicy, SMALL_ROLE),
}
N_ROLES, N_MOVES = 2, 5


def policy_space(height: int = 25, width: int = 25) -> spaces.Dict:
    """Return a space like that of area search within ``RoleWrapper``."""
    return spaces.Dict(
        {
            "local": spaces.Box(0, 1, (4, 9, 9), np.uint8),
            "joint": spaces.Box(0, 1, (2, height, width), np.uint8),
            "position": spaces.Box(0.0, 1e3, (2,), np.float32),
            "state": spaces.Box(0, 1, (5, height, width), np.uint8),
            "sub_goal": spaces.Box(0.0, np.inf, (2, 6), np.float32),
            "agent": spaces.Box(0.0, np.inf, (2,), np.float32),
            "role": spaces.Box(0.0, 1.0, (N_ROLES,), np.float32),
            "role_due": spaces.Box(0.0, 1.0, (1,), np.float32),
        }
    )


def make_policy(kind: str, space: spaces.Dict | None = None, seed: int = 0, **options: Any) -> Any:
    """Return a small policy whose choices and values are far from uniform and from 0."""
    th.manual_seed(seed)
    policy_class, small = POLICIES[kind]
    actions = (
        spaces.Discrete(N_MOVES) if kind == "mappo" else spaces.MultiDiscrete([N_ROLES, N_MOVES])
    )
    policy = policy_class(
        policy_space() if space is None else space, actions, lambda _: 1e-3, **{**small, **options}
    )
    return sharpen(policy)


def sharpen(policy: TeamPolicy) -> TeamPolicy:
    """Undo the small outputs of a fresh policy: what it decides then depends on what it sees."""
    with th.no_grad():
        for module in policy.modules():
            if isinstance(module, Head):
                module.out.weight.mul_(2.0 / module.gain)
                module.out.bias.normal_()
    policy.set_training_mode(False)
    return policy


def make_observation(
    n_teams: int, n_agents: int, height: int = 25, width: int = 25, seed: int = 0
) -> dict[str, th.Tensor]:
    """Return random observations of whole teams; maps shared by a team are given for each row."""
    rng = np.random.default_rng(seed)
    rows = n_teams * n_agents

    def maps(n: int, *shape: int) -> np.ndarray:
        return (rng.random((n, *shape)) < 0.3).astype(np.uint8)

    arrays = {
        "local": maps(rows, 4, 9, 9),
        "joint": maps(n_teams, 2, height, width).repeat(n_agents, axis=0),
        "position": rng.integers(0, height, (rows, 2)).astype(np.float32),
        "state": maps(n_teams, 5, height, width).repeat(n_agents, axis=0),
        "sub_goal": rng.random((rows, 2, 6), np.float32) * 5,
        "agent": np.tile(
            np.stack([np.arange(n_agents), np.full(n_agents, n_agents)], axis=1), (n_teams, 1)
        ).astype(np.float32),
        "role": np.eye(N_ROLES, dtype=np.float32)[rng.integers(0, N_ROLES, rows)],
        "role_due": np.ones((rows, 1), np.float32),
    }
    return {key: th.as_tensor(array) for key, array in arrays.items()}


def small_search(
    n_teams: int = 2,
    backend: str = "native",
    expand: bool = False,
    sub_goal: str = "none",
    roles: dict[str, Any] | None = None,
    **options: Any,
) -> VecEnv:
    """Return teams on small maps, in a ``RoleWrapper`` if it is given its options."""
    options = {"height": 11, "width": 11, "n_targets": 12, "horizon": 10, "n_agents": 3} | options

    def make() -> AreaSearchEnv:
        return AreaSearchEnv(sub_goal=sub_goal, **options)

    env = make_team_vec_env(make, n_teams, 0, backend, expand_team_observations=expand)
    return env if roles is None else RoleWrapper(env, **roles)


class _Ignore(BaseCallback):
    def _on_step(self) -> bool:
        return True


def collect(model: OnPolicyAlgorithm) -> None:
    """Fill the model's rollout buffer, without an update."""
    _, callback = model._setup_learn(10**6, _Ignore())
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, model.n_steps)


def weights(model: OnPolicyAlgorithm) -> dict[str, th.Tensor]:
    """Copy all parameters and statistics of a model's policy."""
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def same(first: dict[str, th.Tensor], second: dict[str, th.Tensor]) -> bool:
    """Whether two sets of weights are equal bit by bit."""
    return first.keys() == second.keys() and all(th.equal(first[k], second[k]) for k in first)


class LogRecorder(KVWriter):
    """Keeps everything that is logged, one dict for each dump."""

    def __init__(self) -> None:
        self.dumps: list[dict[str, Any]] = []

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, Any], step: int = 0
    ) -> None:
        self.dumps.append(dict(key_values))

    def close(self) -> None:
        pass


def record_logs(model: OnPolicyAlgorithm) -> list[dict[str, Any]]:
    """Return a list to which a dict is added at each dump of the model's logs."""
    recorder = LogRecorder()
    model.set_logger(Logger(folder=None, output_formats=[recorder]))
    return recorder.dumps
