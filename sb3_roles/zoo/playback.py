"""Play single episodes with a learned or scripted controller, and show them frame by frame."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from area_search.batch import BatchedAreaSearch
from area_search.render import draw_frame
from sb3_roles.common.files import write_atomically
from sb3_roles.evaluation.episodes import Player

if TYPE_CHECKING:
    from pettingzoo import ParallelEnv

    from area_search.scenes import Scene
    from sb3_roles.baselines.base import Controller
    from sb3_roles.evaluation.policies import PolicyController

Show = Callable[[np.ndarray], object]


def play_scene(
    controller: Controller,
    scene: Scene,
    seed: int,
    episode: int,
    show: Show | None = None,
    show_links: bool = True,
) -> tuple[dict[str, float], np.ndarray]:
    """Play one episode of area search.

    :param controller: who acts
    :param scene: the task
    :param seed: of the stream of episodes
    :param episode: its number in the stream
    :param show: gets a frame of the start and one after each step, uint8 (height, width, 3)
    :param show_links: draw which robots can communicate
    :return: the metrics of the episode, and the roles int8 (steps, n_agents), -1 without roles
    """
    batch = BatchedAreaSearch(scene, 1, str(getattr(controller, "sub_goal", "none")))
    batch.reset([seed], episode)
    player = Player(controller, batch)
    trail: list[np.ndarray] = []
    roles: list[np.ndarray] = []

    def draw() -> None:
        if show is None:
            return
        shown: dict[str, Any] = {
            "path": np.array(trail, np.int32).reshape(-1, scene.n_agents, 2),
            "metrics": {name: float(value[0]) for name, value in batch.metrics.items()},
        }
        if roles and roles[-1][0] >= 0:
            # Before the first step, robots have no role yet.
            shown["roles"] = roles[-1]
            shown["role_names"] = getattr(controller, "role_names", ("explore", "cover"))
        if not show_links:
            shown["communication_radius"] = 0.0
        show(draw_frame(batch.snapshot(0, **shown)))

    draw()
    while not (batch.terminated[0] or batch.truncated[0]):
        trail.append(batch.position[0].copy())
        player.step()
        nobody = np.full(scene.n_agents, -1, np.int8)
        roles.append(nobody if player.roles is None else player.roles[0].copy())
        draw()
    return batch.episode_metrics(0), np.array(roles)


def draw_last(controller: Controller, scene: Scene, seed: int, episode: int, path: Path) -> None:
    """Draw the last frame of an episode into a file.

    :param controller: who acts
    :param scene: the task
    :param seed: of the stream of episodes
    :param episode: its number in the stream
    :param path: a PNG file
    """
    import pygame

    frames: deque[np.ndarray] = deque(maxlen=1)
    links = bool(getattr(controller, "communicate", True))
    play_scene(controller, scene, seed, episode, frames.append, links)
    image = io.BytesIO()
    pygame.image.save(pygame.surfarray.make_surface(frames[0].swapaxes(0, 1)), image, "frame.png")
    write_atomically(path, image.getvalue())


def play_env(
    controller: PolicyController,
    env: ParallelEnv,
    seed: int,
    show: Show | None = None,
) -> tuple[dict[str, float], np.ndarray]:
    """Play one episode of any PettingZoo environment.

    :param controller: the policy
    :param env: it is reset with ``seed``; its robots must finish together
    :param seed: of the episode, and of the draws of its actions
    :param show: gets what ``render()`` returns, at the start and after each step
    :return: ``return`` (summed over the robots), ``length`` and the environment's
        ``episode_metrics``; and the roles int8 (steps, n_agents), -1 without roles
    """
    agents = list(env.possible_agents)
    rng = np.random.default_rng(seed)
    observations, _ = env.reset(seed=seed)
    controller.start(1, len(agents))
    metrics = {"return": 0.0, "length": 0.0}
    roles = []
    infos: dict[str, Any] = {}
    over = False
    while True:
        if show is not None:
            show(np.asarray(env.render()))
        if over:
            break
        given = [observations[agent] for agent in agents]
        if isinstance(given[0], dict):
            rows = {key: np.stack([one[key] for one in given]) for key in controller.keys}
        else:
            rows = {"observation": np.stack(given)}
        moves = controller.choose(rows, rng.random((len(agents), 3)))
        actions = dict(zip(agents, moves.tolist(), strict=True))
        observations, rewards, terminated, truncated, infos = env.step(actions)
        nobody = np.full(len(agents), -1, np.int8)
        roles.append(nobody if controller.roles is None else controller.roles[0].copy())
        metrics["return"] += float(sum(rewards.values()))
        metrics["length"] += 1
        over = any(terminated.values()) or any(truncated.values()) or not env.agents
    return {**metrics, **infos.get(agents[0], {}).get("episode_metrics", {})}, np.array(roles)
