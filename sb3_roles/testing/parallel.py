"""``check_parallel_env``: all checks of an environment in one call."""

from __future__ import annotations

from sb3_roles.common.env_declarations import declared
from sb3_roles.testing.batches import check_batched_equals_single
from sb3_roles.testing.ends import (
    check_agents_live_together,
    check_episode_ends,
    check_no_aliasing,
)
from sb3_roles.testing.episodes import MakeEnv, check_given
from sb3_roles.testing.seeds import (
    check_actions_matter,
    check_determinism,
    check_fresh_process,
    check_reset_forgets,
    check_seed_matters,
    check_state_round_trip,
    state_methods,
)
from sb3_roles.testing.values import (
    check_agents,
    check_dtypes_and_shapes,
    check_finite,
    check_infos,
    check_spaces,
)


def check_parallel_env(
    make_env: MakeEnv,
    n_steps: int = 200,
    seed: int = 0,
    *,
    max_episode_steps: int = 1000,
    horizon: int | None = None,
    live_together: bool = True,
    has_chance: bool = True,
    fresh_process: bool = False,
) -> None:
    """Check a PettingZoo parallel environment: everything of this package that applies to it.

    Beside PettingZoo's own ``parallel_api_test`` and ``parallel_seed_test``, which see neither
    values nor the steps after the first. ``get_state`` and ``set_state``, and ``batched``, are
    checked where the environment has them; one of the two alone is refused.

    Example::

        from sb3_roles.testing import check_parallel_env

        def test_my_env():
            check_parallel_env(MyEnv, horizon=100)

    :param make_env: makes a new environment at each call: its class, for example
    :param n_steps: steps of each check; some play as many several times
    :param seed: of play
    :param max_episode_steps: steps within which every episode ends
    :param horizon: steps after which an episode is truncated, and not before, if there is such a
        number
    :param live_together: whether all agents start and end together, which teams need
    :param has_chance: whether another seed gives another play
    :param fresh_process: whether to compare with a new process, too; that takes seconds, and
        ``make_env`` must be importable there, see :func:`check_fresh_process`
    :raises ConformanceError: an AssertionError of one line: agent, step, what was expected
    :raises TypeError: if ``make_env`` can not be called
    :raises ValueError: if another argument is not allowed
    """
    check_given(make_env, seed, n_steps=n_steps)
    check_agents(make_env, n_steps, seed)
    if live_together:
        check_agents_live_together(make_env, n_steps, seed)
    check_episode_ends(make_env, max_episode_steps, horizon, seed=seed)
    for check in (check_dtypes_and_shapes, check_finite, check_spaces, check_infos):
        check(make_env, n_steps, seed)
    for check in (check_determinism, check_no_aliasing, check_reset_forgets):
        check(make_env, n_steps, seed)
    if has_chance:
        check_seed_matters(make_env, n_steps, seed)
    check_actions_matter(make_env, n_steps, seed)
    env = make_env()
    if state_methods(env):
        check_state_round_trip(make_env, n_steps, seed)
    # A wrapper is left out by the batched form of what it wraps.
    if declared(env, "batched") is not None and env is env.unwrapped:
        check_batched_equals_single(make_env, n_steps, seed)
    if fresh_process:
        check_fresh_process(make_env, n_steps, seed)
