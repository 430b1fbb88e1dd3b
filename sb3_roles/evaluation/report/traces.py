"""Single episodes, step by step, small enough to be part of a page."""

from __future__ import annotations

import base64
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from area_search.batch import BatchedAreaSearch
from area_search.scenes import Scene, get_scene
from sb3_roles.evaluation.episodes import Player, held_out_seed
from sb3_roles.evaluation.grid.crews import error_line
from sb3_roles.evaluation.grid.entrants import Entrant, Entrants
from sb3_roles.evaluation.grid.plan import Column, Plan
from sb3_roles.evaluation.records import NO_ROLE

if TYPE_CHECKING:
    from area_search.snapshot import Snapshot
    from sb3_roles.baselines.base import Controller

NEVER = 255
"""In place of a step: not in this episode."""


# Without eq=False the generated comparison would ask for the truth value of whole arrays.
@dataclass(frozen=True, eq=False)
class Trace:
    """One episode of T steps of N robots on a map of H x W cells.

    Whatever else a player shows follows from this: explored cells, the frontier, links between
    robots, open targets and the metrics.

    :param entrant: who played
    :param column: where
    :param episode: number in the held-out stream of the plan
    :param role_names: empty for a controller without roles
    :param communication_radius: in cells; robots strictly nearer are linked
    :param obstacle: bool (H, W)
    :param target: bool (H, W), those under the robots at the start included
    :param position: uint8 (T + 1, N, 2), row and column before the first and after each step
    :param roles: int8 (T, N), role of each robot in the step; None without roles
    :param seen: uint8 (H, W), step after which the cell was explored: 0 at the start, ``NEVER``
    :param covered: uint8 (number of targets,), in the order of the map's rows: step in which the
        target was covered, 0 for those under the robots at the start, ``NEVER``
    """

    entrant: Entrant
    column: Column
    episode: int
    role_names: tuple[str, ...]
    communication_radius: float
    obstacle: np.ndarray
    target: np.ndarray
    position: np.ndarray
    roles: np.ndarray | None
    seen: np.ndarray
    covered: np.ndarray


def record_traces(
    plan: Plan,
    entrants: Entrants,
    make: Callable[[Entrant], Controller],
    episodes: Sequence[int] = (0, 1, 2),
    columns: Collection[Column] | None = None,
    tell: Callable[[str], None] = print,
) -> list[Trace]:
    """Play the first entrant of every row once more, in every column of the plan where it plays.

    The episodes are those of the tables: numbers ``episodes`` of the plan's held-out stream. A row
    whose controller can not be made, or fails, is left out, whatever was raised.

    :param plan: rows and columns
    :param entrants: rows that have none are left out
    :param make: makes the controller of an entrant
    :param episodes: numbers in the stream
    :param columns: of the plan, those to play; None for all
    :param tell: takes lines: how many episodes are played, and each row that is left out
    :return: in the order of rows, then columns, then episodes
    """
    wanted: dict[str, list[Column]] = {row: [] for row in plan.rows}
    for row, column in plan.cells():
        if entrants.get(row) and (columns is None or column in columns):
            wanted[row].append(column)
    seed = held_out_seed(plan.seed)
    traces: list[Trace] = []
    n_episodes = len(episodes) * sum(map(len, wanted.values()))
    if n_episodes:
        tell(f"playing {n_episodes} episodes for the player")
    for row, places in wanted.items():
        if not places:
            continue
        entrant, found = entrants[row][0], []
        try:
            controller = make(entrant)
            for column in places:
                scene = get_scene(column.scene, n_agents=column.n_agents)
                found += play_traces(controller, scene, entrant, column, seed, episodes)
        except Exception as error:
            tell(f"{row} is left out of the player: {error_line(error, entrant)}")
            continue
        traces += found
    return traces


def play_traces(
    controller: Controller,
    scene: Scene,
    entrant: Entrant,
    column: Column,
    seed: int,
    episodes: Sequence[int],
) -> list[Trace]:
    """Play episodes of one controller, together.

    :param controller: who plays
    :param scene: where
    :param entrant: named in the traces
    :param column: named in the traces
    :param seed: of the stream
    :param episodes: numbers in the stream
    :raises ValueError: if the map or the horizon does not fit in bytes
    """
    if max(scene.height, scene.width) > 255 or scene.horizon >= NEVER:
        raise ValueError(
            f"a trace holds maps of at most 255 x 255 cells and {NEVER - 1} steps, scene "
            f"{scene.name} has {scene.height} x {scene.width} and {scene.horizon}"
        )
    n_teams = len(episodes)
    batch = BatchedAreaSearch(scene, n_teams, str(getattr(controller, "sub_goal", "none")))
    batch.reset([seed] * n_teams, list(episodes))
    recorders = [_Recorder(batch.snapshot(m)) for m in range(n_teams)]
    player = Player(controller, batch)
    playing = np.ones(n_teams, np.bool_)
    while playing.any():
        player.step()
        for m in np.flatnonzero(playing):
            roles = None if player.roles is None else player.roles[m]
            recorders[m].add(batch.snapshot(int(m)), roles)
        # Ended teams go on moving, because the batch steps as a whole.
        playing &= ~(batch.terminated | batch.truncated)
    names = () if player.roles is None else tuple(getattr(controller, "role_names", ()))
    return [
        Trace(
            entrant=entrant,
            column=column,
            episode=int(episode),
            role_names=names,
            communication_radius=scene.communication_radius,
            obstacle=recorder.obstacle,
            target=recorder.target,
            position=np.stack(recorder.position).astype(np.uint8),
            roles=np.stack(recorder.roles).astype(np.int8) if recorder.roles else None,
            seen=recorder.seen,
            covered=recorder.covered[recorder.target],
        )
        for episode, recorder in zip(episodes, recorders, strict=True)
    ]


class _Recorder:
    """Notes when the cells of one team's map were explored and covered."""

    def __init__(self, start: Snapshot) -> None:
        self.obstacle = start.obstacle
        self.target = start.target_open | start.target_covered
        self.seen = np.where(start.explored, 0, NEVER).astype(np.uint8)
        self.covered = np.where(start.target_covered, 0, NEVER).astype(np.uint8)
        self.position = [start.position]
        self.roles: list[np.ndarray] = []

    def add(self, now: Snapshot, roles: np.ndarray | None) -> None:
        self.seen[now.explored & (self.seen == NEVER)] = now.step
        self.covered[now.target_covered & (self.covered == NEVER)] = now.step
        self.position.append(now.position)
        if roles is not None:
            self.roles.append(roles.copy())


def encode_traces(traces: Sequence[Trace]) -> dict[str, list[dict[str, Any]]]:
    """Pack traces into JSON values: arrays become base64 of their bytes, maps are kept once.

    :param traces: of any scenes
    :return: ``maps``, with bits of obstacles and targets, and ``episodes``, each with the index of
        its map
    """
    maps: dict[tuple[Any, ...], int] = {}
    episodes = []
    for trace in traces:
        height, width = trace.obstacle.shape
        bits = [_text(np.packbits(one)) for one in (trace.obstacle, trace.target)]
        entrant = trace.entrant
        one: dict[str, Any] = {
            "row": entrant.row,
            "scene": trace.column.scene,
            "n_agents": trace.column.n_agents,
            "episode": trace.episode,
            "training_seed": entrant.training_seed,
            "map": maps.setdefault((height, width, *bits), len(maps)),
            "radius": trace.communication_radius,
            "role_names": list(trace.role_names),
            "position": _text(trace.position),
            "seen": _text(trace.seen),
            "covered": _text(trace.covered),
        }
        if trace.roles is not None:
            # Bytes without a sign: NO_ROLE becomes NEVER.
            one["roles"] = _text(np.where(trace.roles == NO_ROLE, NEVER, trace.roles))
        episodes.append(one)
    names = ("height", "width", "obstacle", "target")
    return {"maps": [dict(zip(names, key, strict=True)) for key in maps], "episodes": episodes}


def _text(array: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(array, np.uint8).tobytes()).decode("ascii")
