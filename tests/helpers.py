"""What several test modules of the area-search environment share."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from area_search import BatchedAreaSearch, Scene, kernels
from area_search import cells as layout

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


def boards(batch: BatchedAreaSearch) -> np.ndarray:
    """Copy the maps without their borders: uint8 (n_teams, height, width)."""
    border = (batch.cells.shape[1] - batch.scene.height) // 2
    return batch.cells[:, border:-border, border:-border].copy()


def has(board: np.ndarray, bit: int) -> np.ndarray:
    """Return where a bit is set."""
    return (board & bit) > 0


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
