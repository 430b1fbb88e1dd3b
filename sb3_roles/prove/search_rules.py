"""The invariants themselves: one function each, over all teams at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from gymnasium import spaces

from area_search import cells as layout
from area_search import kernels
from area_search.cells import N_ACTIONS
from sb3_roles.prove.search_maps import Seen, has

Rule = Callable[[Seen], np.ndarray]
"""Returns bool (n_teams,): where it holds."""

_ROUNDING = 1e-6


def _same(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether arrays are equal, team by team."""
    return np.asarray((first == second).reshape(len(first), -1).all(axis=1))


def _close(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    near = np.asarray(np.isclose(first, second, rtol=_ROUNDING, atol=_ROUNDING))
    return np.asarray(near.reshape(len(first), -1).all(axis=1))


def _none(wrong: np.ndarray) -> np.ndarray:
    return np.asarray(~wrong.reshape(len(wrong), -1).any(axis=1))


def _at_robots(seen: Seen, maps: np.ndarray) -> np.ndarray:
    row, column = np.moveaxis(seen.batch.position, 2, 0)
    last = np.array(maps.shape[1:]) - 1
    team = np.arange(len(maps))[:, None]
    return maps[team, np.clip(row, 0, last[0]), np.clip(column, 0, last[1])]


def on_free_cells(seen: Seen) -> np.ndarray:
    """Robots are on the map, on free cells."""
    position, size = seen.batch.position, np.array(seen.board.shape[1:])
    on_map = ((position >= 0) & (position < size)).all(axis=(1, 2))
    return on_map & _none(_at_robots(seen, seen.obstacle))


def moves(seen: Seen) -> np.ndarray:
    """Each robot moved by one cell, as its action says, or stayed where the way was blocked.

    Robots may share cells and pass through each other.
    """
    return _same(seen.batch.position, seen.wanted)


def map_stays(seen: Seen) -> np.ndarray:
    """Obstacles stay where they are, and are as many as the scene says."""
    obstacle = has(seen.board, layout.OBSTACLE)
    count = obstacle.sum(axis=(1, 2)) == seen.batch.scene.n_obstacles
    return count & _same(obstacle, seen.obstacle)


def targets_stay(seen: Seen) -> np.ndarray:
    """Covered, known and hidden targets are those of the reset, as many as the scene says."""
    target, covered = has(seen.board, layout.TARGET), has(seen.board, layout.COVERED)
    count = seen.targets.sum(axis=(1, 2)) == seen.batch.scene.n_targets
    return (
        count
        & _same(target | covered, seen.targets)
        & _none(target & covered)
        & _none(seen.targets & seen.obstacle)
    )


def explored_is_what_was_seen(seen: Seen) -> np.ndarray:
    """The team's map is the union of what its robots have sensed since the reset: it only grows."""
    return _same(has(seen.board, layout.EXPLORED), seen.explored)


def covered_is_what_was_visited(seen: Seen) -> np.ndarray:
    """Covered targets are those that a robot has stood on: they only become more."""
    return _same(has(seen.board, layout.COVERED), seen.targets & seen.visited)


def knowledge(seen: Seen) -> np.ndarray:
    """Known are explored obstacles, explored uncovered targets, and the frontier by definition."""
    open_targets = seen.targets & ~seen.visited
    return (
        _same(has(seen.board, layout.KNOWN_OBSTACLE), seen.obstacle & seen.explored)
        & _same(has(seen.board, layout.KNOWN_TARGET), open_targets & seen.explored)
        & _same(has(seen.board, layout.FRONTIER), seen.frontier)
        & _same(has(seen.board, layout.ROBOT), seen.robots)
    )


def counts(seen: Seen) -> np.ndarray:
    """The counts that metrics are made of agree with the maps."""
    totals = seen.batch.totals
    free = (seen.explored & ~seen.obstacle).sum(axis=(1, 2))
    return (
        (totals[:, kernels.SEEN] == seen.seen)
        & (totals[:, kernels.SEEN_FREE] == free)
        & (totals[:, kernels.COVERED_SCORED] == seen.covered)
    )


def finds(seen: Seen) -> np.ndarray:
    """Each new cell and target counts for one robot, the first one in the order of indices."""
    kept = _same(seen.batch.new_cells, seen.grown) & _same(seen.batch.new_targets, seen.found)
    return kept | ~seen.stepped


def rewards(seen: Seen) -> np.ndarray:
    """Reward components are those of Eq. 6, shared as the scene says, and their sum Eq. 2."""
    batch, scene = seen.batch, seen.batch.scene
    found = np.stack([batch.new_cells / scene.explore_normalizer, batch.new_targets], axis=2)
    if scene.reward_sharing == "same_role":
        same = (batch.roles[:, :, None] == batch.roles[:, None, :]).astype(float)
        shared = same @ found
    else:
        mean = found.mean(axis=1, keepdims=True)
        shared = (1 - scene.team_share) * found + scene.team_share * mean
    total = scene.alpha * shared[..., 0] + scene.beta * shared[..., 1]
    kept = _close(batch.reward_components, shared) & _close(batch.rewards, total)
    return kept | ~seen.stepped


def metrics(seen: Seen) -> np.ndarray:
    """Metrics agree with the maps; explo_true and cover lie in [0, 1].

    explo_paper counts obstacles, too, over the free cells: it may exceed 1, by all obstacles.
    """
    batch, scene = seen.batch, seen.batch.scene
    free = (seen.explored & ~seen.obstacle).sum(axis=(1, 2))
    paper, true, cover = (batch.metrics[name] for name in ("explo_paper", "explo_true", "cover"))
    kept = (
        _close(paper, seen.seen / scene.n_free)
        & _close(true, free / scene.n_free)
        & _close(cover, seen.covered / scene.n_targets)
        & (paper >= 0)
        & (paper <= scene.n_cells / scene.n_free)
        & (true >= 0)
        & (true <= 1)
        & (cover >= 0)
        & (cover <= 1)
    )
    return kept | ~seen.stepped


def ends(seen: Seen) -> np.ndarray:
    """An episode is truncated at the horizon, and terminated by impatience, and not otherwise."""
    batch, scene = seen.batch, seen.batch.scene
    patience = scene.early_stop_patience
    stuck = (seen.idle >= (np.inf if patience is None else patience)).any(axis=1)
    kept = (batch.truncated == (seen.steps >= scene.horizon)) & (batch.terminated == stuck)
    return (batch.steps == seen.steps) & (kept | ~seen.stepped) & (seen.steps <= scene.horizon)


def in_spaces(seen: Seen) -> np.ndarray:
    """Observations have the declared dtype and shape, and lie within the declared bounds."""
    batch = seen.batch
    kept = np.ones(batch.n_teams, bool)
    for key, value in batch.observations.items():
        space = batch.observation_space[key]
        assert isinstance(space, spaces.Box)
        lead = 1 if key in batch.team_observation_keys else 2
        if value.dtype != space.dtype or value.shape[lead:] != space.shape:
            return np.zeros(batch.n_teams, bool)
        if (space.low == space.low.flat[0]).all() and (space.high == space.high.flat[0]).all():
            # The same for all entries, and faster; of NaN it is False, too.
            axes = tuple(range(1, value.ndim))
            kept &= value.min(axis=axes) >= space.low.flat[0]
            kept &= value.max(axis=axes) <= space.high.flat[0]
        else:
            kept &= _none(~((value >= space.low) & (value <= space.high)))
    return kept


def joint_maps(seen: Seen) -> np.ndarray:
    """The maps that a team shares, the state, position and time show what is there."""
    batch, shown = seen.batch, seen.batch.observations
    known = seen.targets & ~seen.visited & seen.explored
    layers = {
        "joint": (seen.frontier, known),
        "state": (
            seen.obstacle,
            seen.frontier,
            seen.targets & ~seen.visited,
            seen.robots,
            seen.explored,
        ),
        "known": (seen.explored & ~seen.obstacle, seen.explored & seen.obstacle),
    }
    kept = _same(shown["position"], batch.position)
    for key, maps in layers.items():
        if key in shown:
            for channel, layer in enumerate(maps):
                kept &= _same(shown[key][:, channel], layer)
    if "time" in shown:
        horizon = batch.scene.horizon
        kept &= _close(shown["time"][:, 0], (horizon - seen.steps) / horizon)
    return kept


def _windows(seen: Seen, maps: np.ndarray, beyond: bool) -> np.ndarray:
    """Cut the robots' windows out of maps: bool (n_teams, n_agents, side, side)."""
    reach = seen.batch.scene.view_radius
    padded = np.pad(maps, ((0, 0), (reach, reach), (reach, reach)), constant_values=beyond)
    view = np.lib.stride_tricks.sliding_window_view(padded, (2 * reach + 1,) * 2, axis=(1, 2))
    return _at_robots(seen, view)


def local_windows(seen: Seen) -> np.ndarray:
    """A robot's window shows the team's map around it; off the map is known obstacle."""
    known = seen.targets & ~seen.visited & seen.explored
    shown = seen.batch.observations["local"]
    kept = np.ones(len(shown), bool)
    for channel, (maps, beyond) in enumerate(
        ((seen.obstacle & seen.explored, True), (seen.frontier, False), (known, False))
    ):
        kept &= _same(shown[:, :, channel], _windows(seen, maps, beyond))
    return kept


def communication(seen: Seen) -> np.ndarray:
    """Robots see each other, both or neither, where strictly nearer than the radius and in view."""
    scene, position = seen.batch.scene, seen.batch.position
    n_teams, n_agents = position.shape[:2]
    offset = position[:, None] - position[:, :, None]
    within = (offset**2).sum(axis=3) < scene.communication_radius**2
    in_view = (np.abs(offset) <= scene.view_radius).all(axis=3)
    expected = in_view & (within | (offset == 0).all(axis=3))
    reach = scene.view_radius
    row, column = np.moveaxis(np.clip(offset, -reach, reach) + reach, 3, 0)
    shown = seen.batch.observations["local"][:, :, 3] > 0
    team, robot = np.arange(n_teams)[:, None, None], np.arange(n_agents)[None, :, None]
    sees = in_view & shown[team, robot, row, column]
    drawn = np.zeros_like(shown)
    team, robot, _ = np.nonzero(expected)
    drawn[team, robot, row[expected], column[expected]] = True
    return _same(sees, expected) & _same(sees, sees.transpose(0, 2, 1)) & _same(shown, drawn)


def sub_goals(seen: Seen) -> np.ndarray:
    """A goal has a first move, onto a known free cell, exactly where its nearness is above 0."""
    shown = seen.batch.observations.get("sub_goal")
    if shown is None:
        return np.ones(seen.batch.n_teams, bool)
    first = np.asarray(shown[..., :2, :N_ACTIONS] > 0)
    kept = _same(np.asarray(first.any(axis=3)), shown[..., :2, N_ACTIONS] > 0)
    ground = seen.explored & ~seen.obstacle
    size = np.array(ground.shape[1:])
    for action in range(1, N_ACTIONS):
        move = np.array([layout.MOVE_ROWS[action], layout.MOVE_COLUMNS[action]])
        there = seen.batch.position + move
        inside = ((there >= 0) & (there < size)).all(axis=2)
        row, column = np.moveaxis(np.clip(there, 0, size - 1), 2, 0)
        open_way = inside & ground[np.arange(len(ground))[:, None], row, column]
        kept &= _none(first[..., action] & ~open_way[..., None])
    return kept


RULES: dict[str, Rule] = {
    rule.__name__: rule
    for rule in (
        on_free_cells,
        moves,
        map_stays,
        targets_stay,
        explored_is_what_was_seen,
        covered_is_what_was_visited,
        knowledge,
        counts,
        finds,
        rewards,
        metrics,
        ends,
        in_spaces,
        joint_maps,
        local_windows,
        communication,
        sub_goals,
    )
}
