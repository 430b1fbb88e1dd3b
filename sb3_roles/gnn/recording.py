"""Record what a controller does in numbered episodes of area search."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from area_search.batch import BatchedAreaSearch
from area_search.kernels import METRICS
from area_search.scenes import Scene, get_scene
from sb3_roles._version import __version__
from sb3_roles.baselines import controller_class
from sb3_roles.common.checks import check_whole
from sb3_roles.gnn.demonstrations import (
    DemonstrationError,
    Demonstrations,
    load_demonstrations,
    pack_maps,
)

if TYPE_CHECKING:
    from sb3_roles.baselines.base import Controller

# No other stream is counted from here: neither that of a training, of 32 bits, nor that of an
# evaluation. Demonstrations are episodes that nothing is tested on.
_STREAM = 2**62


def record(
    controller: str | Controller,
    scene: Scene | str,
    n_episodes: int,
    seed: int,
    path: Path | None = None,
    name: str | None = None,
    batch_size: int = 25,
    report: Callable[[int], None] | None = None,
) -> Demonstrations:
    """Record the first episodes of a seed's stream, or go on with a recording that was stopped.

    An episode is a function of its scene, seed and number, and so is what a scripted controller
    does in it: a recording that was stopped and taken up again is the same, up to what a
    controller makes of its time limit.

    :param controller: name of a scripted controller, or a controller with ``begin()``
    :param scene: the task; an early stop is switched off
    :param n_episodes: how many
    :param seed: of a stream that is used for demonstrations only
    :param path: file to write after every ``batch_size`` episodes; what it holds is not recorded
        again; None keeps everything in memory
    :param name: what the file calls the controller; by default its name or class
    :param batch_size: episodes that are played together
    :param report: told how many episodes are there, after every ``batch_size`` of them
    :return: the demonstrations, ``n_episodes`` of them
    :raises DemonstrationError: if the file is damaged, or of another controller, scene or seed
    :raises ValueError: if a number is out of range, or the controller or scene unknown
    """
    check_whole(1, n_episodes=n_episodes, batch_size=batch_size)
    check_whole(0, seed=seed)
    scene = get_scene(scene).with_options(early_stop_patience=None)
    player: Any = controller_class(controller)() if isinstance(controller, str) else controller
    if name is None:
        name = controller if isinstance(controller, str) else type(controller).__name__
    facts = {"controller": name, "seed": int(seed), "scene": scene.facts()}
    done: list[Demonstrations] = []
    if path is not None and path.exists():
        done = [_taken_up(path, facts)]
    have = sum(len(part) for part in done)
    while have < n_episodes:
        numbers = np.arange(have, min(have + batch_size, n_episodes), dtype=np.int64)
        done = [_joined([*done, _play(player, scene, seed, numbers, facts)])]
        have = len(done[0])
        if path is not None:
            done[0].save(path)
        if report is not None:
            report(have)
    return done[0].first(n_episodes)


def _taken_up(path: Path, facts: dict[str, Any]) -> Demonstrations:
    """Read what was recorded so far, if it is of the same recording."""
    earlier = load_demonstrations(path)
    for key, value in facts.items():
        saved = earlier.facts.get(key)
        if saved != value:
            if isinstance(value, dict) and isinstance(saved, dict):
                key, value, saved = next(
                    (f"the scene's {k}", value.get(k), saved.get(k))
                    for k in {**value, **saved}
                    if value.get(k) != saved.get(k)
                )
            raise DemonstrationError(
                f"{path}: holds other demonstrations: {key} is {saved!r} there, {value!r} here; "
                "choose another file"
            )
    if not np.array_equal(earlier.episodes, np.arange(len(earlier))):
        raise DemonstrationError(f"{path}: its episodes are not 0, 1, 2, ...; choose another file")
    return earlier


def _joined(parts: list[Demonstrations]) -> Demonstrations:
    names = ("episodes", "maps", "positions", "actions", "metrics")
    return Demonstrations(
        parts[-1].facts, *(np.concatenate([getattr(p, n) for p in parts]) for n in names)
    )


def _play(
    controller: Any, scene: Scene, seed: int, numbers: np.ndarray, facts: dict[str, Any]
) -> Demonstrations:
    """Play and record some episodes."""
    sub_goal = str(getattr(controller, "sub_goal", "none"))
    batch = BatchedAreaSearch(scene, len(numbers), sub_goal, known_map=True)
    batch.reset([_STREAM + int(seed)] * len(numbers), numbers)
    controller.begin(batch)
    lead = (len(numbers), scene.horizon)
    maps = np.zeros((*lead, *pack_maps(*_maps(batch)).shape[1:]), np.uint8)
    positions = np.zeros((*lead, scene.n_agents, 2), np.int16)
    actions = np.zeros((*lead, scene.n_agents), np.int8)
    for t in range(scene.horizon):
        maps[:, t] = pack_maps(*_maps(batch))
        positions[:, t] = batch.position
        chosen, _ = controller.predict({}, None, None, True)
        batch.step(chosen.reshape(batch.n_teams, batch.n_agents))
        # A blocked move does what a stop does, and is no edge of the graph.
        moved = (batch.position != positions[:, t]).any(axis=-1)
        actions[:, t] = np.where(moved, chosen.reshape(moved.shape), 0)
    metrics = np.stack([batch.metrics[name] for name in METRICS], axis=1)
    facts = {**facts, "version": __version__}
    return Demonstrations(facts, numbers, maps, positions, actions, metrics.copy())


def _maps(batch: BatchedAreaSearch) -> tuple[np.ndarray, np.ndarray]:
    return batch.observations["known"], batch.observations["joint"]
