"""Vectorized environments of robot teams: one maker, two backends."""

from collections.abc import Callable
from typing import Literal

from pettingzoo import ParallelEnv

from sb3_roles.common.base_team_vec_env import TeamVecEnv, team_seeds
from sb3_roles.common.names import closest
from sb3_roles.common.native_vec_env import BatchedTeamEnv, NativeTeamVecEnv
from sb3_roles.common.supersuit_vec_env import SuperSuitTeamVecEnv

__all__ = [
    "BACKENDS",
    "BatchedTeamEnv",
    "NativeTeamVecEnv",
    "SuperSuitTeamVecEnv",
    "TeamVecEnv",
    "make_team_vec_env",
    "team_seeds",
]

Backend = Literal["auto", "native", "supersuit"]
BACKENDS: tuple[str, ...] = ("auto", "native", "supersuit")


def make_team_vec_env(
    env: ParallelEnv | Callable[[], ParallelEnv],
    n_envs: int,
    seed: int | None = None,
    backend: Backend | str = "auto",
    *,
    expand_team_observations: bool = True,
) -> TeamVecEnv:
    """
    Vectorize a multi-agent environment; rows are robots, contiguous by team.

    Both backends give the same trajectories for the same seed. ``"native"`` uses the environment's
    ``batched(n_teams)``, see :class:`BatchedTeamEnv`; ``"supersuit"`` takes any ``ParallelEnv``
    with homogeneous agents; ``"auto"`` takes native where the environment itself has it. A
    wrapper does not: its inner environment's batched form would leave the wrapper out.

    :param env: a function without arguments that makes a PettingZoo ``ParallelEnv``, or an
        instance, which the SuperSuit backend has to copy by pickling
    :param n_envs: number of teams, that is, of copies of the environment
    :param seed: seed of the first reset; ``None`` for fresh entropy
    :param backend: ``"auto"``, ``"native"`` or ``"supersuit"``
    :param expand_team_observations: ``False`` returns observations shared by a team once per team,
        for algorithms that know it; see :class:`TeamVecEnv`
    :raises ValueError: if the backend is unknown or not offered by the environment, ``n_envs < 1``,
        or the environment does not fit, see :class:`SuperSuitTeamVecEnv`
    :raises TypeError: if ``env`` is neither an environment nor a function that makes one
    """
    if backend not in BACKENDS:
        raise ValueError(closest("backend", backend, BACKENDS))
    if n_envs < 1:
        raise ValueError(f"n_envs is {n_envs}: at least one team is needed")
    instance = env if isinstance(env, ParallelEnv) or not callable(env) else env()
    if not isinstance(instance, ParallelEnv):
        raise TypeError(
            f"env must be a pettingzoo.ParallelEnv or a function that makes one, got {instance!r}. "
            "Convert an AEC environment with pettingzoo.utils.conversions.aec_to_parallel"
        )
    batched = _batched_maker(instance)
    vec_env: TeamVecEnv
    if backend == "supersuit" or (backend == "auto" and batched is None):
        vec_env = SuperSuitTeamVecEnv(
            instance,
            n_envs,
            make=None if instance is env else env,
            expand_team_observations=expand_team_observations,
        )
    elif batched is None:
        raise ValueError(
            f"backend 'native' needs a method batched(n_teams), which {type(instance).__name__} "
            "itself does not have (one of a wrapped environment would leave the wrapper out): use "
            "backend='supersuit', or give it one that returns a BatchedTeamEnv"
        )
    else:
        vec_env = NativeTeamVecEnv(
            batched(n_envs),
            expand_team_observations=expand_team_observations,
            env=instance,
        )
    if seed is not None:
        vec_env.seed(seed)
    return vec_env


def _batched_maker(env: ParallelEnv) -> Callable[[int], BatchedTeamEnv] | None:
    # Not getattr(env, ...): PettingZoo's wrappers forward it to what they wrap.
    own = "batched" in vars(env) or hasattr(type(env), "batched")
    maker = env.batched if own else None
    return maker if callable(maker) else None
