"""Callbacks of training, for every algorithm of SB3 and sb3-contrib on ``make_team_vec_env``.

``get_state()`` of those that keep records returns plain data, arrays, numbers and texts, from which
``set_state()`` continues.
"""

from sb3_roles.common.base_callback import (
    Evaluate,
    TeamCallback,
    role_options,
    role_wrapper_of,
)
from sb3_roles.common.metrics_callback import TeamEpisode, TeamMetricsCallback
from sb3_roles.common.progress_callback import TeamProgressBar
from sb3_roles.common.role_callback import RoleCallback, RoleEpisode

__all__ = [
    "Evaluate",
    "RoleCallback",
    "RoleEpisode",
    "TeamCallback",
    "TeamEpisode",
    "TeamMetricsCallback",
    "TeamProgressBar",
    "role_options",
    "role_wrapper_of",
]
