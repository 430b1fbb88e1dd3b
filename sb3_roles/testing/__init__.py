"""Conformance checks that anyone can call on an environment, a buffer or a loss of their own.

Each raises a :class:`ConformanceError`, an ``AssertionError`` of one line that says who, when, and
what was expected; a check that returns has found nothing::

    from sb3_roles.testing import check_parallel_env

    def test_my_env():
        check_parallel_env(MyEnv, horizon=100)
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sb3_roles.testing.batches import check_batched_equals_single
    from sb3_roles.testing.buffers import check_team_buffer
    from sb3_roles.testing.ends import (
        check_agents_live_together,
        check_episode_ends,
        check_no_aliasing,
    )
    from sb3_roles.testing.episodes import ConformanceError
    from sb3_roles.testing.losses import check_stream_loss
    from sb3_roles.testing.parallel import check_parallel_env
    from sb3_roles.testing.returns import check_returns
    from sb3_roles.testing.seeds import (
        check_actions_matter,
        check_determinism,
        check_fresh_process,
        check_reset_forgets,
        check_seed_matters,
        check_state_round_trip,
    )
    from sb3_roles.testing.values import (
        check_agents,
        check_dtypes_and_shapes,
        check_finite,
        check_infos,
        check_spaces,
    )

__all__ = [
    "ConformanceError",
    "check_actions_matter",
    "check_agents",
    "check_agents_live_together",
    "check_batched_equals_single",
    "check_determinism",
    "check_dtypes_and_shapes",
    "check_episode_ends",
    "check_finite",
    "check_fresh_process",
    "check_infos",
    "check_no_aliasing",
    "check_parallel_env",
    "check_reset_forgets",
    "check_returns",
    "check_seed_matters",
    "check_spaces",
    "check_state_round_trip",
    "check_stream_loss",
    "check_team_buffer",
]

_HOME = {
    "ConformanceError": "episodes",
    "check_actions_matter": "seeds",
    "check_agents": "values",
    "check_agents_live_together": "ends",
    "check_batched_equals_single": "batches",
    "check_determinism": "seeds",
    "check_dtypes_and_shapes": "values",
    "check_episode_ends": "ends",
    "check_finite": "values",
    "check_fresh_process": "seeds",
    "check_infos": "values",
    "check_no_aliasing": "ends",
    "check_parallel_env": "parallel",
    "check_reset_forgets": "seeds",
    "check_returns": "returns",
    "check_seed_matters": "seeds",
    "check_spaces": "values",
    "check_state_round_trip": "seeds",
    "check_stream_loss": "losses",
    "check_team_buffer": "buffers",
}


def __getattr__(name: str) -> Any:
    # Those of buffers and losses need torch, which takes seconds to import.
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME[name]}"), name)
