"""Roles over the steps of recorded episodes."""

from __future__ import annotations

import numpy as np

from sb3_roles.evaluation.records import NO_ROLE, EpisodeRecords


def role_shares(records: EpisodeRecords, role: str) -> np.ndarray | None:
    """Return the share of the robots that act in a role.

    :param records: of a controller
    :param role: its name
    :return: float64 (E, horizon), nan after the end of an episode; None if there is no such role
    """
    names = records.metadata["role_names"]
    if role not in names:
        return None
    acting = (records.roles != NO_ROLE).sum(axis=2)
    chosen = (records.roles == names.index(role)).sum(axis=2)
    return np.where(acting > 0, chosen / np.maximum(acting, 1), np.nan)


def role_switches(records: EpisodeRecords) -> np.ndarray | None:
    """Return the share of the robots whose role is another one than in the step before.

    :param records: of a controller
    :return: float64 (E, horizon - 1): entry t is the change from step t + 1 to step t + 2; nan
        after the end of an episode; None without roles
    """
    if not records.metadata["role_names"]:
        return None
    before, after = records.roles[:, :-1], records.roles[:, 1:]
    acting = ((before != NO_ROLE) & (after != NO_ROLE)).sum(axis=2)
    changed = ((before != after) & (before != NO_ROLE) & (after != NO_ROLE)).sum(axis=2)
    return np.where(acting > 0, changed / np.maximum(acting, 1), np.nan)
