"""What is wrong with a configuration: every key on its own, and keys that do not go together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sb3_roles.common.names import closest, shown
from sb3_roles.common.roles import NEAREST, ROLES, role_controls
from sb3_roles.zoo.algorithms import ALGORITHMS, POLICY_ARGUMENTS, Algorithm
from sb3_roles.zoo.environments import (
    AREA_SEARCH,
    GOAL_SETS,
    REWARD_COMPONENTS,
    SUB_GOALS,
    env_problems,
    scenes_of_run,
)
from sb3_roles.zoo.options import MAX_TRAINING_SEED
from sb3_roles.zoo.ranges import Choice, Items, Range, Text, Weights, Whole, problems

NESTED = ("env_kwargs", "wrapper_kwargs", "policy_kwargs")
RADIUS = "communication_radius"
# The wrapper and the backends have these, behind numba and SB3, which take seconds to import.
REWARD_SHARING = ("own", "same_role", "team")
VEC_ENVS = ("auto", "native", "supersuit")
_RUN: dict[str, Range] = {"n_timesteps": Whole(1, 1e12), "n_envs": Whole(1, 1e5)}
# Options of the command line, which a run's configuration holds, too.
IDENTITY: dict[str, Range] = {
    "algo": Choice(tuple(ALGORITHMS)),
    "env": Text(),
    "seed": Whole(0, MAX_TRAINING_SEED),
    "vec_env": Choice(VEC_ENVS),
}


def config_problems(config: Mapping[str, Any]) -> list[str]:
    """Find all that is wrong with a whole configuration.

    :param config: as :func:`~sb3_roles.zoo.config.resolve` returns it
    :return: one line per problem
    """
    algo, env = config.get("algo"), config.get("env")
    if not isinstance(algo, str) or algo not in ALGORITHMS:
        return [closest("algorithm", algo, ALGORITHMS)]
    algorithm = ALGORITHMS[algo]
    if not isinstance(env, str):
        return [f"env must be a name or module:factory, got {shown(env)}"]
    top: dict[str, Range] = {
        **_RUN,
        "policy": Choice(tuple(algorithm.policies)),
        **algorithm.parameters,
    }
    nested = {key: config[key] for key in NESTED if key in config}
    identity = {key: config[key] for key in IDENTITY if key in config}
    flat = {key: config[key] for key in config if key not in (*nested, *identity)}
    found = problems("", identity, IDENTITY)
    # The nested keys are here for the closest match of a mistyped one.
    found += problems("", flat, {**top, **dict.fromkeys(NESTED, Weights())})
    for key, value in nested.items():
        if not isinstance(value, Mapping):
            found.append(f"{key} must be keys and values, got {shown(value)}")
    if isinstance(config.get("env_kwargs"), Mapping):
        found += env_problems(env, config["env_kwargs"])
    if isinstance(config.get("wrapper_kwargs"), Mapping):
        found += _wrapper_problems(algorithm, env, config["wrapper_kwargs"])
    policy = config.get("policy")
    known = isinstance(policy, str) and policy in POLICY_ARGUMENTS
    if known and isinstance(config.get("policy_kwargs"), Mapping):
        found += problems("policy_kwargs", config["policy_kwargs"], POLICY_ARGUMENTS[str(policy)])
    return found or _together(config)


def _wrapper_problems(algorithm: Algorithm, env: str, options: Mapping[str, Any]) -> list[str]:
    if algorithm.wrapper == "team":
        if options:
            return [f"wrapper_kwargs must be empty: {algorithm.name} has no roles, got {options}"]
        return []
    roles = options.get("roles", ["explore", "cover"])
    names = roles if isinstance(roles, list) else ()
    role_names = tuple(name for name in names if isinstance(name, str))
    found = problems(
        "wrapper_kwargs",
        options,
        {
            "roles": Items(Choice(tuple(ROLES)), least=1),
            "role_weights": Weights(optional=True),
            "primitive_weights": Choice(("identity", "role_reward"), matrix=True),
            "reward_sharing": Choice(REWARD_SHARING),
            "role_every": Whole(1, 1e6),
            "role_control": Choice(role_controls(role_names)),
        },
    )
    if not algorithm.holds_roles and not found:
        for key, only in (("role_every", 1), ("role_control", "learned")):
            if options.get(key, only) != only:
                found.append(
                    f"wrapper_kwargs.{key} must be {only} for {algorithm.name}, whose policy "
                    f"chooses a role at every step, got {shown(options[key])}"
                )
    if not found:
        found += _role_problems(role_names or ("explore", "cover"), options)
    if env == AREA_SEARCH and not found:
        found += _component_problems(options)
    return found


def _role_problems(roles: tuple[str, ...], options: Mapping[str, Any]) -> list[str]:
    """Roles that are there twice, and weights of roles that are not there."""
    if len(set(roles)) < len(roles):
        return [f"wrapper_kwargs.roles must be different ones, each once, got {list(roles)}"]
    matrix = options.get("primitive_weights")
    if not isinstance(matrix, Mapping):
        return []
    found = [
        f"wrapper_kwargs.primitive_weights: {closest('role', name, roles)}"
        for name in matrix
        if name not in roles
    ]
    missing = [name for name in roles if name not in matrix]
    if missing:
        found.append(
            f"wrapper_kwargs.primitive_weights must have weights for each of {', '.join(roles)}, "
            f"got none for {', '.join(missing)}"
        )
    return found


def _component_problems(options: Mapping[str, Any]) -> list[str]:
    tables = {"role_weights": options.get("role_weights") or {}}
    matrix = options.get("primitive_weights")
    if isinstance(matrix, Mapping):
        tables |= {f"primitive_weights.{role}": weights for role, weights in matrix.items()}
    return [
        f"wrapper_kwargs.{table}: {closest('reward component', name, REWARD_COMPONENTS)}"
        for table, weights in tables.items()
        for name in weights
        if name not in REWARD_COMPONENTS
    ]


def links_robots(config: Mapping[str, Any]) -> bool:
    """Whether the policy has a graph of the robots that can communicate in area search."""
    return config["env"] == AREA_SEARCH and RADIUS in POLICY_ARGUMENTS[config["policy"]]


def _together(config: Mapping[str, Any]) -> list[str]:
    """What is wrong with values that are right one by one."""
    found: list[str] = []
    n_steps, batch_size = config.get("n_steps"), config.get("batch_size")
    of_rollout = not ALGORITHMS[config["algo"]].clones
    if of_rollout and n_steps and batch_size and batch_size > n_steps * config["n_envs"]:
        found.append(
            f"batch_size must be at most n_steps x n_envs = {n_steps} x {config['n_envs']} = "
            f"{n_steps * config['n_envs']} joint steps, got {batch_size}"
        )
    groups = config.get("rollout_groups", 1)
    if groups > config["n_envs"]:
        found.append(
            f"rollout_groups must be at most n_envs = {config['n_envs']} teams, got {groups}"
        )
    found += _policy_problems(config["policy_kwargs"])
    if config["env"] != AREA_SEARCH:
        return found
    env_kwargs, policy_kwargs = config["env_kwargs"], config["policy_kwargs"]
    scenes = scenes_of_run(config)
    found += _mix_problems(config, len(scenes))
    if links_robots(config) and RADIUS in policy_kwargs:
        # Scenes of a mix agree in it.
        given, radius = policy_kwargs[RADIUS], scenes[0].communication_radius
        if given != radius:
            found.append(
                f"policy_kwargs.{RADIUS} must be the environment's, {radius:g}, got {given}: "
                f"leave it out, and give env_kwargs.{RADIUS}"
            )
    if ALGORITHMS[config["algo"]].wrapper == "role":
        if env_kwargs.get("reward_sharing", "own") != "own":
            # Robots would be paid twice for their team mates, once by each of the two.
            found.append(
                f"env_kwargs.reward_sharing must be own for {config['algo']}, got "
                f"{env_kwargs['reward_sharing']}: with roles, wrapper_kwargs.reward_sharing shares"
            )
        sharing = config["wrapper_kwargs"].get("reward_sharing", "own")
        if scenes[0].team_share > 0.0 and sharing != "own":
            found.append(
                f"env_kwargs.team_share must be 0 with wrapper_kwargs.reward_sharing {sharing}, "
                f"which shares already, got {scenes[0].team_share:g}"
            )
        found += [
            f"env_kwargs.{key} weighs nothing for {config['algo']}: with roles, "
            "wrapper_kwargs.role_weights do"
            for key in ("alpha", "beta")
            if key in env_kwargs
        ]
        found += _goal_problems(config)
    return found


def _policy_problems(options: Mapping[str, Any]) -> list[str]:
    """Arguments of a policy that do not go together."""
    found = []
    optimizer = options.get("optimizer_kwargs", {})
    if optimizer.get("fused") and optimizer.get("foreach"):
        found.append("policy_kwargs.optimizer_kwargs: fused and foreach must not both be true")
    heads, width = options.get("n_heads"), options.get("hop_width")
    if heads is not None and width is not None and width % heads:
        found.append(
            f"policy_kwargs.n_heads must divide hop_width, {width}, without a rest, got {heads}"
        )
    layer = options.get("norm_layer", "none")
    if options.get("encoder") == "patches" and layer != "none":
        found.append(
            f"policy_kwargs.norm_layer must be none with encoder patches, which have none, got "
            f"{layer}"
        )
    if "state" in (options.get("actor_keys") or ()):
        found.append("policy_kwargs.actor_keys: actors never read 'state', which is for critics")
    return found


def _mix_problems(config: Mapping[str, Any], n_scenes: int) -> list[str]:
    if n_scenes == 1:
        return []
    found = []
    if ALGORITHMS[config["algo"]].clones:
        found.append(f"env_kwargs.scene must be one scene for {config['algo']}, got {n_scenes}")
    if config["vec_env"] == "supersuit":
        found.append(
            f"env_kwargs.scene must be one scene with vec_env supersuit, got {n_scenes}: the "
            "native one divides its teams over a mix"
        )
    if config["n_envs"] < n_scenes:
        found.append(
            f"n_envs must be at least the number of scenes, {n_scenes}, got {config['n_envs']}: "
            "each is played by a team of its own"
        )
    return found


def _goal_problems(config: Mapping[str, Any]) -> list[str]:
    """Check that there are sub-goals, and row k of them is for role k, as a policy takes it."""
    sub_goal = config["env_kwargs"].get("sub_goal", "none")
    if sub_goal == "none":
        lacking = [
            name
            for name, value in (
                ("policy_kwargs.goal_key", config["policy_kwargs"].get("goal_key")),
                ("wrapper_kwargs.role_control", config["wrapper_kwargs"].get("role_control")),
            )
            if value in ("sub_goal", NEAREST)
        ]
        return [
            f"{name} needs sub-goals: env_kwargs.sub_goal must be one of "
            f"{', '.join(SUB_GOALS[1:])}, got none"
            for name in lacking
        ]
    roles = [ROLES[name] for name in config["wrapper_kwargs"].get("roles", ("explore", "cover"))]
    sets = tuple(role.goal_set for role in roles)
    if config["policy_kwargs"].get("goal_key") != "sub_goal" or sets == GOAL_SETS:
        return []
    rows = "explore and cover" if sub_goal == "role_routes" else " and ".join(GOAL_SETS)
    return [
        f"policy_kwargs.goal_key: the first rows of sub_goal are for {rows}, but the "
        f"roles {', '.join(role.name for role in roles)} head for "
        f"{', '.join(name or 'nothing' for name in sets)}"
    ]
