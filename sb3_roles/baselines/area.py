"""What area search is played in, for those who make controllers and episodes of an environment."""

from __future__ import annotations

from stable_baselines3.common.vec_env import VecEnv

from area_search.scenes import Scene
from sb3_roles.common.team_wrapper import find_team_env


def area_scene(env: VecEnv | None) -> Scene | None:
    """Return the scene of an area-search environment, below any wrappers; None of another one.

    :param env: a vectorized environment of teams
    :raises ValueError: if its rows are not those of a ``TeamVecEnv``
    """
    try:
        scene = find_team_env(env).get_attr("scene", [0])[0]
    except AttributeError:
        return None
    return scene if isinstance(scene, Scene) else None
