"""What area search is played in, for those who make controllers and episodes of an environment."""

from __future__ import annotations

from stable_baselines3.common.vec_env import VecEnv

from area_search.scenes import Scene, only_scene
from sb3_roles.common.team_wrapper import find_team_env


def area_scenes(env: VecEnv | None) -> tuple[Scene, ...]:
    """Return the scenes of an area-search environment, below any wrappers; none of another one.

    :param env: a vectorized environment of teams
    :raises ValueError: if its rows are not those of a ``TeamVecEnv``
    """
    try:
        scenes = find_team_env(env).get_attr("scenes", [0])[0]
    except AttributeError:
        return ()
    of_area = isinstance(scenes, tuple) and all(isinstance(scene, Scene) for scene in scenes)
    return scenes if of_area else ()


def area_scene(env: VecEnv | None) -> Scene | None:
    """Return the scene of an area-search environment, below any wrappers; None of another one.

    :param env: a vectorized environment of teams
    :raises ValueError: if its teams play several, or its rows are not those of a ``TeamVecEnv``
    """
    scenes = area_scenes(env)
    return only_scene(scenes) if scenes else None
