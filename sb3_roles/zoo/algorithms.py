"""The algorithms of the command line: what each is made of, and what its configuration may hold.

Importing this module imports no torch: a wrong configuration is refused before that takes its time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from typing import Any

from sb3_roles.baselines import CONTROLLER_NAMES
from sb3_roles.common.names import closest
from sb3_roles.zoo.ranges import (
    Choice,
    Flag,
    Items,
    Number,
    OneOrMany,
    Options,
    Range,
    Text,
    Whole,
    schedule_start,
)

_TEAM_BUFFER = {"rollout_buffer_class": "sb3_roles.common.buffers:TeamRolloutBuffer"}
_ROLE_POLICY = {"RolePolicy": "sb3_roles.hmappo.policies:RoleActorCriticPolicy"}
_WIDTHS = Items(Whole(1, 65536))
_SOME_WIDTHS = Items(Whole(1, 65536), least=1)
_CHANNELS = Items(Whole(1, 65536), optional=True, least=1)
_KEYS = Items(optional=True, least=1)
_COEFFICIENT = Number(0.0, 1e6)
_RATE = Number(0.0, 10.0, schedule=True)
_CLIP = Number(0.0, 1.0, above=True, schedule=True)
_UNIT = Number(0.0, 1.0)
_OPTIMIZER = Options(
    {
        "fused": Flag(),
        "foreach": Flag(),
        "eps": Number(0.0, 1.0, above=True),
        "betas": Items(_UNIT, least=2, most=2),
        "weight_decay": Number(0.0, 1.0),
        "amsgrad": Flag(),
    }
)

_PRIOR = Number(0.0, 100.0)
_TEAM_POLICY: dict[str, Range] = {
    "actor_keys": _KEYS,
    "critic_keys": _KEYS,
    "share_encoders": Flag(),
    "norm_layer": Choice(("none", "frozen_batch", "group")),
    "graph": Flag(),
    "graph_width": Whole(1, 65536),
    "communication_radius": Number(0.0, 1e6, optional=True),
    "encoder": Choice(("convolutions", "patches")),
    "local_channels": _CHANNELS,
    "joint_channels": _CHANNELS,
    "state_channels": _CHANNELS,
    "precision": Choice(("auto", "fp32", "bf16")),
    "optimizer_kwargs": _OPTIMIZER,
}
# Of the critic and the optimizer: the actor is the graph.
_GRAPH_POLICY: dict[str, Range] = {
    **{
        key: _TEAM_POLICY[key]
        for key in (
            "critic_keys",
            "norm_layer",
            "encoder",
            "local_channels",
            "joint_channels",
            "state_channels",
            "precision",
            "optimizer_kwargs",
        )
    },
    "n_hops": Whole(1, 1000),
    "hop_width": Whole(1, 65536),
    "head_arch": _WIDTHS,
    "value_arch": _WIDTHS,
}
POLICY_ARGUMENTS: dict[str, dict[str, Range]] = {
    "TeamPolicy": {
        **_TEAM_POLICY,
        "actor_arch": _WIDTHS,
        "head_arch": _WIDTHS,
        "value_arch": _WIDTHS,
        "goal_key": Text(optional=True),
        "goal_prior": OneOrMany(_PRIOR),
    },
    "GNNPolicy": _GRAPH_POLICY,
    "H2GNNPolicy": {**_GRAPH_POLICY, "n_heads": Whole(1, 1024)},
    "RolePolicy": {
        **_TEAM_POLICY,
        "role_arch": _WIDTHS,
        "role_head_arch": _WIDTHS,
        "primitive_keys": _KEYS,
        "primitive_input": Choice(("own", "graph")),
        "primitive_arch": _SOME_WIDTHS,
        "value_arch": _SOME_WIDTHS,
        "see_role": Flag(),
        "goal_key": Text(optional=True),
        "goal_prior": _PRIOR,
        "other_goal_prior": _PRIOR,
        "shared_goal_prior": _PRIOR,
    },
    "RowPolicy": {"net_arch": _WIDTHS, "optimizer_kwargs": _OPTIMIZER},
    "RecurrentRowPolicy": {
        "net_arch": _WIDTHS,
        "lstm_hidden_size": Whole(1, 65536),
        "n_lstm_layers": Whole(1, 16),
        "shared_lstm": Flag(),
        "enable_critic_lstm": Flag(),
        "optimizer_kwargs": _OPTIMIZER,
    },
}

_COMMON: dict[str, Range] = {
    "learning_rate": _RATE,
    "n_steps": Whole(1, 1e6),
    "gamma": _UNIT,
    "gae_lambda": _UNIT,
    "vf_coef": _COEFFICIENT,
    "stats_window_size": Whole(1, 1e6),
}
_MAPPO: dict[str, Range] = {
    **_COMMON,
    "batch_size": Whole(1, 1e9),
    "n_epochs": Whole(1, 1000),
    "n_shards": Whole(1, 1024),
    "rollout_groups": Whole(1, 1024),
    "clip_range": _CLIP,
    "normalize_advantage": Flag(),
    "ent_coef": Number(0.0, 1e6, schedule=True),
    "kl_coef": _COEFFICIENT,
    "kl_target": Number(0.0, 1e6, above=True),
    "max_grad_norm": Number(0.0, 1e9, above=True, optional=True),
    "target_kl": Number(0.0, 1e6, above=True, optional=True),
}
_STOCK: dict[str, Range] = {
    **_COMMON,
    "ent_coef": _COEFFICIENT,
    "max_grad_norm": Number(0.0, 1e9, above=True),
    "normalize_advantage": Flag(),
}
_PPO: dict[str, Range] = {
    **_STOCK,
    "batch_size": Whole(1, 1e9),
    "n_epochs": Whole(1, 1000),
    "clip_range": _CLIP,
    "clip_range_vf": Number(0.0, 1e6, above=True, optional=True, schedule=True),
    "target_kl": Number(0.0, 1e6, above=True, optional=True),
}
_TRPO: dict[str, Range] = {
    **{key: _STOCK[key] for key in _STOCK if key not in ("ent_coef", "vf_coef", "max_grad_norm")},
    "batch_size": Whole(1, 1e9),
    "cg_max_steps": Whole(1, 1e4),
    "cg_damping": _COEFFICIENT,
    "line_search_shrinking_factor": Number(0.0, 1.0, above=True),
    "line_search_max_iter": Whole(1, 1000),
    "n_critic_updates": Whole(1, 1000),
    "target_kl": Number(0.0, 1e6, above=True),
}

# Constructor arguments that no configuration sets: the command line or the registry does, or they
# are for other kinds of actions.
NOT_CONFIGURED = frozenset(
    {
        "policy",
        "env",
        "policy_kwargs",
        "tensorboard_log",
        "verbose",
        "seed",
        "device",
        "use_sde",
        "sde_sample_freq",
        "rollout_buffer_class",
        "rollout_buffer_kwargs",
        "sub_sampling_factor",
        "_init_setup_model",
    }
)


@dataclass(frozen=True)
class Algorithm:
    """One algorithm of ``--algo``.

    Configurations count ``n_steps`` and ``batch_size`` in joint steps, whatever the class counts.

    :param name: on the command line, of its folder of runs and of its configuration
    :param path: ``module:Class``
    :param wrapper: ``"role"`` (``RoleWrapper``) or ``"team"`` (``TeamWrapper``)
    :param policies: names of a configuration -> ``module:Class``; the first is the default
    :param parameters: constructor arguments that a configuration may set, and their ranges
    :param extra: constructor arguments that are always given; ``module:Class`` is imported
    :param batch_in_rows: the class counts ``batch_size`` in robots' rows
    :param whole_teams: what a team shares is handed over once per team; False repeats it by row
    :param masks: the environment tells which moves are blocked
    :param holds_roles: its policy keeps a role that goes on, so that roles may last or be given
    :param clones: it learns from demonstrations, and batches are of those: it has ``check_data()``,
        ``data()``, ``facts`` and ``summary()`` of :class:`~sb3_roles.gnn.gnn.GNN`
    :param options: defaults of ``sb3-roles train`` that are its own
    """

    name: str
    path: str
    wrapper: str
    policies: Mapping[str, str]
    parameters: Mapping[str, Range]
    extra: Mapping[str, Any] = field(default_factory=dict)
    batch_in_rows: bool = True
    whole_teams: bool = True
    masks: bool = False
    holds_roles: bool = True
    clones: bool = False
    options: Mapping[str, Any] = field(default_factory=dict)

    @property
    def checks_steps(self) -> bool:
        """Whether it refuses by itself to learn from numbers that are not finite."""
        return self.path.startswith("sb3_roles.")

    def load(self) -> Any:
        """Import the class."""
        return load_object(self.path)

    def policy(self, name: str) -> Any:
        """Import the class of one of ``policies``."""
        return load_object(self.policies[name])

    def arguments(self, config: Mapping[str, Any], n_agents: int) -> dict[str, Any]:
        """Return the constructor's keyword arguments for a checked configuration.

        :param config: the whole configuration
        :param n_agents: robots in a team
        :return: all but environment and policy, which are the first two
        """
        arguments = {
            key: _with_schedule(value) for key, value in config.items() if key in self.parameters
        }
        if self.batch_in_rows and "batch_size" in arguments:
            arguments["batch_size"] *= n_agents
        for key, value in self.extra.items():
            arguments[key] = load_object(value) if isinstance(value, str) else value
        arguments["policy_kwargs"] = dict(config.get("policy_kwargs") or {})
        betas = arguments["policy_kwargs"].get("optimizer_kwargs", {}).get("betas")
        if betas is not None:
            optimizer = {**arguments["policy_kwargs"]["optimizer_kwargs"], "betas": tuple(betas)}
            arguments["policy_kwargs"]["optimizer_kwargs"] = optimizer
        return arguments


def load_object(path: str) -> Any:
    """Import ``module:name``."""
    module, name = path.split(":")
    return getattr(import_module(module), name)


def _with_schedule(value: Any) -> Any:
    """Turn ``lin_5.0e-4`` into a function of the progress that remains."""
    start = schedule_start(value) if isinstance(value, str) else None
    if start is None:
        return value
    from stable_baselines3.common.utils import LinearSchedule

    return LinearSchedule(start, 0.0, 1.0)


_MAPPO_ALGORITHM = Algorithm(
    "mappo",
    "sb3_roles.mappo:MAPPO",
    "team",
    {"TeamPolicy": "sb3_roles.mappo.policies:TeamActorCriticPolicy"},
    _MAPPO,
    batch_in_rows=False,
)
ALGORITHMS: dict[str, Algorithm] = {
    algorithm.name: algorithm
    for algorithm in (
        Algorithm(
            "hmappo",
            "sb3_roles.hmappo:HMAPPO",
            "role",
            _ROLE_POLICY,
            {
                **_MAPPO,
                "role_gamma": Number(0.0, 1.0, optional=True),
                "role_gae_lambda": Number(0.0, 1.0, optional=True),
                "role_clip_range": Number(0.0, 1.0, above=True, optional=True, schedule=True),
                "role_ent_coef": Number(0.0, 1e6, optional=True, schedule=True),
                "role_vf_coef": Number(0.0, 1e6, optional=True),
                "role_kl_coef": Number(0.0, 1e6, optional=True),
            },
            batch_in_rows=False,
        ),
        _MAPPO_ALGORITHM,
        # Blumenkamp and Prorok's policy is MAPPO's with the networks of its configuration.
        replace(_MAPPO_ALGORITHM, name="ecc"),
        Algorithm(
            "gnn",
            "sb3_roles.gnn:GNN",
            "team",
            {"GNNPolicy": "sb3_roles.gnn.policies:GNNPolicy"},
            {
                "demonstrations": Text(optional=True),
                "controller": Choice(CONTROLLER_NAMES),
                "n_demonstrations": Whole(2, 1e6),
                "validation_share": Number(0.0, 1.0, above=True),
                "learning_rate": Number(0.0, 10.0),
                "lr_decay": _UNIT,
                "lr_decay_every": Whole(1, 1e9),
                "batch_size": Whole(1, 1e6),
                "patience": Whole(1, 1e6, optional=True),
                "n_steps": Whole(1, 1e6),
                "stats_window_size": Whole(1, 1e6),
            },
            batch_in_rows=False,
            clones=True,
            # Five epochs of its configuration: joint steps are few where playing teaches nothing.
            options={"eval_freq": 1000, "save_freq": 1000},
        ),
        replace(
            _MAPPO_ALGORITHM,
            name="h2gnn",
            policies={"H2GNNPolicy": "sb3_roles.gnn.policies:H2GNNPolicy"},
        ),
        Algorithm("ppo", "stable_baselines3:PPO", "role", _ROLE_POLICY, _PPO, _TEAM_BUFFER),
        Algorithm(
            "a2c",
            "stable_baselines3:A2C",
            "role",
            _ROLE_POLICY,
            {
                **_STOCK,
                "rms_prop_eps": Number(0.0, 1.0, above=True),
                "use_rms_prop": Flag(),
            },
            _TEAM_BUFFER,
        ),
        # A sub-sampled batch would take every k-th row, and tear teams apart.
        Algorithm(
            "trpo",
            "sb3_contrib:TRPO",
            "role",
            _ROLE_POLICY,
            _TRPO,
            {**_TEAM_BUFFER, "sub_sampling_factor": 1},
        ),
        # These two have policies of their own, of one robot each: contrib's buffers mix rows, so
        # there is no graph and no critic that reads the state.
        Algorithm(
            "maskable_ppo",
            "sb3_contrib:MaskablePPO",
            "role",
            {"RowPolicy": "sb3_roles.common.row_policies:MaskedRowPolicy"},
            _PPO,
            whole_teams=False,
            masks=True,
        ),
        Algorithm(
            "recurrent_ppo",
            "sb3_contrib:RecurrentPPO",
            "role",
            {"RecurrentRowPolicy": "sb3_roles.common.row_policies:RecurrentRowPolicy"},
            _PPO,
            whole_teams=False,
            holds_roles=False,
        ),
    )
}


def get_algorithm(name: str) -> Algorithm:
    """Look an algorithm up.

    :param name: as on the command line
    :raises ValueError: if there is none of that name
    """
    if name not in ALGORITHMS:
        raise ValueError(closest("algorithm", name, ALGORITHMS))
    return ALGORITHMS[name]
