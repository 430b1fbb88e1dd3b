"""The state of a vectorized environment and its wrappers: taken, put back, divided by teams."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from sb3_roles.common.base_team_vec_env import TeamVecEnv
from sb3_roles.common.env_failures import called
from sb3_roles.common.native_vec_env import NativeTeamVecEnv
from sb3_roles.common.team_wrapper import find_team_env

EnvState = dict[str, Any]
"""``teams``: a state for each environment below, one for all teams on the native backend, or None
if there is none; ``wrappers``: a state for each wrapper that has one."""


def _wrappers(env: VecEnv, method: str) -> Iterator[Any]:
    """Go through the wrappers that have a method, the outermost first."""
    layer: Any = env
    while isinstance(layer, VecEnvWrapper):
        if hasattr(layer, method):
            yield layer
        layer = layer.venv


def _team_rows(env: VecEnv) -> list[int]:
    """One row for each environment below: the native backend has one for all teams."""
    team_env = find_team_env(env)
    native = isinstance(team_env, NativeTeamVecEnv)
    return [0] if native else list(range(0, team_env.num_envs, team_env.n_agents))


def env_name(env: VecEnv) -> str:
    """Return what messages call an environment."""
    metadata = find_team_env(env).metadata or {}
    return f"environment {metadata.get('name', 'of this run')}"


def env_gap(env: VecEnv) -> str | None:
    """Return why an environment can not be continued bit for bit; None if it can."""
    team_env = find_team_env(env)
    for method in ("get_state", "set_state"):
        try:
            owners = team_env.get_attr(method, indices=0)
        except AttributeError:
            owners = [None]
        if not callable(owners[0]):
            return f"{env_name(env)} offers no {method}"
    return None


def env_state(env: VecEnv) -> EnvState:
    """Return the state between two steps.

    :param env: was reset
    """
    teams = None
    if env_gap(env) is None:
        team_env = find_team_env(env)
        teams = [_state_of(team_env, row) for row in _team_rows(env)]
    return {"teams": teams, "wrappers": wrapper_states(env)}


def _state_of(team_env: TeamVecEnv, row: int) -> Any:
    (own,) = team_env.get_attr("get_state", indices=row)
    return called(getattr(own, "__self__", own), "get_state()", own)


def wrapper_states(env: VecEnv) -> list[Mapping[str, Any]]:
    """Return the state of each wrapper that has one."""
    return [layer.get_state() for layer in _wrappers(env, "get_state")]


def set_env_state(env: VecEnv, state: Mapping[str, Any]) -> None:
    """Continue from a state.

    :param env: of the same make and number of teams, was reset
    :param state: what :func:`env_state` returned
    :raises ValueError: if it does not fit
    """
    team_env, rows = find_team_env(env), _team_rows(env)
    if len(state["teams"]) != len(rows):
        raise ValueError("the environments' state is of another number of teams")
    for row, one in zip(rows, state["teams"], strict=True):
        # A copy: what came from another process may be read-only, and an environment may keep it.
        team_env.env_method("set_state", copy.deepcopy(one), indices=row)
    set_wrapper_states(env, state["wrappers"])


def set_wrapper_states(env: VecEnv, states: Sequence[Mapping[str, Any]]) -> None:
    """Continue from what :func:`wrapper_states` returned."""
    for layer, one in zip(_wrappers(env, "set_state"), states, strict=True):
        layer.set_state(one)


def laid_out_like(template: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Copy an observation to memory that is laid out as the environment's.

    Convolutions choose their kernel by it, and kernels round differently.

    :param template: of the environment, of any number of rows
    :param values: the same but for the number of rows
    """
    like = np.empty_like(template, shape=values.shape)
    np.copyto(like, values)
    return like


# Parts


def take_rows(values: Mapping[str, np.ndarray], teams: slice, n_teams: int) -> dict[str, Any]:
    """Return what belongs to some teams, as views.

    :param values: by name, each with n_teams leading rows or a multiple of it, in the order of the
        teams
    :param teams: which ones
    :param n_teams: number of all teams
    """
    taken = {}
    for name, value in values.items():
        each = len(value) // n_teams
        taken[name] = value[teams.start * each : teams.stop * each]
    return taken


def join_rows(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Put together what :func:`take_rows` has divided; copies, also of a single part."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def parts_gap(env: VecEnv, state: Mapping[str, Any]) -> str | None:
    """Return why a state can not be divided by teams; None if it can.

    :param env: the environment
    :param state: of :func:`env_state`
    """
    if state["teams"] is None:
        return env_gap(env)
    n_teams = find_team_env(env).n_teams
    own = state["teams"] if isinstance(find_team_env(env), NativeTeamVecEnv) else []
    for one in (*own, *state["wrappers"]):
        arrays = one if isinstance(one, Mapping) else {"it": one}
        for name, value in arrays.items():
            if np.ndim(value) == 0 or len(value) % n_teams:
                return (
                    f"the state of {env_name(env)} can not be divided by teams: {name} is no array "
                    f"with a row, or the same number of rows, for each of {n_teams} teams"
                )
    return None


def take_state(env: VecEnv, state: Mapping[str, Any], teams: slice) -> EnvState:
    """Return the state of some teams, for an environment of only them.

    :param env: the environment of all teams
    :param state: its state, which can be divided, see :func:`parts_gap`
    :param teams: which ones
    """
    team_env = find_team_env(env)
    n_teams = team_env.n_teams
    if isinstance(team_env, NativeTeamVecEnv):
        own = [take_rows(state["teams"][0], teams, n_teams)]
    else:
        own = state["teams"][teams]
    wrappers = [take_rows(one, teams, n_teams) for one in state["wrappers"]]
    return {"teams": own, "wrappers": wrappers}


def join_states(env: VecEnv, parts: Sequence[Mapping[str, Any]]) -> EnvState:
    """Put together the states of consecutive teams.

    :param env: the environment of all teams
    :param parts: in their order
    """
    if isinstance(find_team_env(env), NativeTeamVecEnv):
        teams = [join_rows([part["teams"][0] for part in parts])]
    else:
        teams = [one for part in parts for one in part["teams"]]
    layers = zip(*(part["wrappers"] for part in parts), strict=True)
    return {"teams": teams, "wrappers": [join_rows(layer) for layer in layers]}
