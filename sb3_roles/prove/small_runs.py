"""Runs of seconds, of every algorithm, for experiments that need many of them."""

from __future__ import annotations

from typing import Any

from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.config import resolve
from sb3_roles.zoo.environments import AREA_SEARCH

SMALL_SCENE = {"height": 9, "width": 9, "n_targets": 8, "n_agents": 3, "horizon": 11}
TEAMS, STEPS = 4, 8
ITERATION = TEAMS * STEPS
"""Joint steps of an iteration."""
_STATE = {"local_channels": [2, 2, 2], "state_channels": [2, 2, 2]}
_MAPS = {**_STATE, "joint_channels": [2, 2, 2, 2], "graph_width": 8}
SMALL_POLICIES: dict[str, dict[str, Any]] = {
    "TeamPolicy": {**_MAPS, "actor_arch": [8], "head_arch": [8], "value_arch": [8]},
    "RolePolicy": {
        **_MAPS,
        "role_arch": [8],
        "role_head_arch": [8],
        "primitive_arch": [8],
        "value_arch": [8],
    },
    "GNNPolicy": {**_STATE, "n_hops": 4, "hop_width": 8, "value_arch": [8]},
    "H2GNNPolicy": {**_STATE, "n_hops": 2, "hop_width": 8, "value_arch": [8]},
    "RowPolicy": {"net_arch": [8]},
    "RecurrentRowPolicy": {"net_arch": [8], "lstm_hidden_size": 8},
}
_SMALL_UPDATES = {
    "batch_size": 8,
    "n_epochs": 2,
    "cg_max_steps": 3,
    "n_critic_updates": 2,
    "controller": "greedy_assigned",
    "n_demonstrations": 4,
    "patience": None,
}
# Policies of the graph of known cells, which is observed on demand.
_GRAPHS = ("GNNPolicy", "H2GNNPolicy")


def small_settings(
    algo: str, n_iterations: int, env: str = AREA_SEARCH, **changes: Any
) -> dict[str, Any]:
    """Return the keys of a configuration file for a run of seconds.

    :param algo: of the registry; one that clones records its demonstrations first
    :param n_iterations: iterations of the whole run
    :param env: ``area-search-v0``, or ``module:factory``
    :param changes: keys to replace
    """
    algorithm = ALGORITHMS[algo]
    policy = next(iter(algorithm.policies))
    env_kwargs: dict[str, Any] = {}
    if env == AREA_SEARCH:
        seen = {"known_map": True} if policy in _GRAPHS else {"sub_goal": "nearest"}
        env_kwargs = {**SMALL_SCENE, **seen}
    return {
        "n_timesteps": n_iterations * ITERATION,
        "n_envs": TEAMS,
        "env_kwargs": env_kwargs,
        "policy_kwargs": SMALL_POLICIES[policy],
        # Of cloning it falls by itself.
        "learning_rate": 1e-3 if algorithm.clones else "lin_1.0e-3",
        "n_steps": STEPS,
        "stats_window_size": 10,
        **{key: value for key, value in _SMALL_UPDATES.items() if key in algorithm.parameters},
        **changes,
    }


def small_run(
    algo: str,
    backend: str = "native",
    n_iterations: int = 3,
    env: str = AREA_SEARCH,
    seed: int = 3,
    **changes: Any,
) -> dict[str, Any]:
    """Return the checked configuration of a run of seconds.

    :param algo: see :func:`small_settings`
    :param backend: of ``make_team_vec_env``
    :param n_iterations: see :func:`small_settings`
    :param env: see :func:`small_settings`
    :param seed: of the run
    :param changes: see :func:`small_settings`
    """
    settings = small_settings(algo, n_iterations, env, **changes)
    return resolve(algo, env, settings, seed=seed, vec_env=backend)
