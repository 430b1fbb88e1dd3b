"""Configurations and the registry of algorithms."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import fields
from importlib import import_module
from pathlib import Path
from types import ModuleType

import pytest
import toy_envs
import yaml

from area_search.paths import GOAL_SETS, SUB_GOALS
from area_search.rewards import REWARD_COMPONENTS
from area_search.scenes import SCENES, Scene, get_scene
from sb3_roles.common.checkpoint import Checkpoint, CheckpointError
from sb3_roles.common.role_wrapper import REWARD_SHARING, RoleWrapper
from sb3_roles.common.team_vec_env import BACKENDS
from sb3_roles.common.torch_layers import ENCODERS, NORM_LAYERS, PRECISIONS
from sb3_roles.hmappo.policies import PRIMITIVE_INPUTS
from sb3_roles.zoo import config_checks, environments
from sb3_roles.zoo.algorithms import ALGORITHMS, NOT_CONFIGURED, POLICY_ARGUMENTS, get_algorithm
from sb3_roles.zoo.config import (
    ConfigError,
    load_identity,
    load_settings,
    merge,
    resolve,
    write_yaml,
)
from sb3_roles.zoo.environments import check_named, env_factory
from sb3_roles.zoo.models import (
    complete,
    constructor_parameters,
    make_env,
    make_model,
    steps_of,
)
from sb3_roles.zoo.options import UsageError
from sb3_roles.zoo.ranges import Number, Whole, yaml_number

ROOT = Path(__file__).resolve().parents[1]
# The plan of the tables is the configuration of no algorithm; test_tables_cli reads it.
OTHERS = {"tables.yml", "ablations.yml"}
FILES = sorted(path for path in (ROOT / "zoo_configs").glob("*.yml") if path.name not in OTHERS)
ENV = "area-search-v0"
GOOD = {"n_timesteps": 100}


def lines(algo="hmappo", env=ENV, **settings):
    with pytest.raises(ConfigError) as caught:
        resolve(algo, env, {**GOOD, **settings})
    assert all(line and "\n" not in line for line in caught.value.lines)
    return caught.value.lines


@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=list(ALGORITHMS))
def test_tables_are_the_signatures(algorithm):
    named = set(constructor_parameters(algorithm.load()))
    assert set(algorithm.parameters) == named - NOT_CONFIGURED
    assert set(algorithm.extra) <= named
    for policy in algorithm.policies:
        arguments = set(constructor_parameters(algorithm.policy(policy)))
        known = set(POLICY_ARGUMENTS[policy])
        if algorithm.whole_teams:
            given = {"observation_space", "action_space", "lr_schedule"}
            assert known == arguments - given - {"use_sde", "optimizer_class"}


def test_names_are_those_of_the_code():
    assert SUB_GOALS == environments.SUB_GOALS
    assert GOAL_SETS == environments.GOAL_SETS
    assert REWARD_COMPONENTS == environments.REWARD_COMPONENTS
    assert REWARD_SHARING == config_checks.REWARD_SHARING
    assert BACKENDS == config_checks.VEC_ENVS
    assert POLICY_ARGUMENTS["RolePolicy"]["norm_layer"].names == NORM_LAYERS
    assert POLICY_ARGUMENTS["RolePolicy"]["encoder"].names == ENCODERS
    assert POLICY_ARGUMENTS["RolePolicy"]["precision"].names == PRECISIONS
    assert POLICY_ARGUMENTS["RolePolicy"]["primitive_input"].names == PRIMITIVE_INPUTS


@pytest.mark.parametrize("algo", ALGORITHMS)
@pytest.mark.parametrize("env", [ENV, "toy_envs:PlainEnv"])
def test_every_algorithm_has_a_configuration(algo, env):
    config = resolve(algo, env, load_settings(algo, env))
    whole = complete(config)
    assert config_checks.config_problems(whole) == []
    assert set(whole) >= set(ALGORITHMS[algo].parameters) - {"target_kl", "clip_range_vf"}


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_files(file):
    # Variants are named after the algorithm whose configuration they are.
    algo = max((a for a in ALGORITHMS if f"{file.stem}_".startswith(f"{a}_")), key=len)
    for env in yaml.safe_load(file.read_text()):
        resolve(algo, ENV if env == ENV else "some:factory", load_settings(algo, env, file))


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.stem)
def test_every_key_has_a_tag_and_a_comment(file):
    text = file.read_text()
    lines = text.splitlines()
    found = list(keys_of(yaml.compose(text)))
    assert len(found) > 20
    for key in found:
        line = lines[key.start_mark.line]
        assert re.search(r" # (Paper|Released code|Ours): \S", line), f"{key.value}: {line}"


def keys_of(node):
    """All keys of a YAML document, at any depth."""
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            yield key
            yield from keys_of(value)
    elif isinstance(node, yaml.SequenceNode):
        for value in node.value:
            yield from keys_of(value)


def test_keys_are_found_at_any_depth():
    text = "a:\n  b: {c: 1, d: [{e: 2}]}\n  f: null\n"
    assert [key.value for key in keys_of(yaml.compose(text))] == ["a", "b", "c", "d", "e", "f"]


def test_the_paper_names_every_value():
    """No default of ours is behind the paper's results."""
    settings = load_settings("hmappo", ENV, FILES_BY_NAME["hmappo_paper"])
    whole = complete(resolve("hmappo", ENV, {"n_timesteps": 1}))
    # The radius of the graph is the environment's.
    filled = {"communication_radius"}
    assert set(whole) - set(settings) == {"algo", "env", "seed", "vec_env"}
    named = set(settings["policy_kwargs"])
    assert named >= set(POLICY_ARGUMENTS["RolePolicy"]) - filled
    assert set(settings["wrapper_kwargs"]) == set(constructor_parameters(RoleWrapper)) - {"venv"}
    scene = {field.name for field in fields(Scene)}
    # What the scenes differ in, so that --scene still means what it says; the wrapper's rewards.
    others = {"name", "n_targets", "free_fraction", "alpha", "beta", "reward_sharing", "team_share"}
    assert set(settings["env_kwargs"]) == scene - others | {"scene", "sub_goal"}
    for name in SCENES:
        changed = get_scene(name, **{key: settings["env_kwargs"][key] for key in scene - others})
        assert changed == get_scene(name, early_stop_patience=10)


def test_the_paper_to_the_letter():
    config = resolve("hmappo", ENV, load_settings("hmappo", ENV, FILES_BY_NAME["hmappo_paper"]))
    assert config["n_timesteps"] == 5_000_000
    assert config["n_envs"] * config["n_steps"] == 5000
    assert config["vf_coef"] == 1e-4
    assert config["max_grad_norm"] is None


FILES_BY_NAME = {path.stem: path for path in FILES}


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        (
            {
                "env_kwargs": {"sub_goal": "nearest"},
                "wrapper_kwargs": {"roles": ["cover", "explore"]},
                "policy_kwargs": {"goal_key": "sub_goal"},
            },
            "goal_key: the first rows of sub_goal are for frontier and target, but the roles "
            "cover, explore head for target, frontier",
        ),
        ({"gama": 0.9}, "unknown key 'gama'.*did you mean 'gamma'"),
        ({"env_kwarg": {}}, "did you mean 'env_kwargs'"),
        ({"gamma": 1.5}, r"gamma must be a number in \[0, 1\], got 1.5"),
        ({"gamma": "5e-1"}, r"gamma is '5e-1', which YAML reads as text: write 5.0e-1"),
        ({"learning_rate": "5e-4"}, r"write 5.0e-4"),
        ({"learning_rate": "lin_x"}, "learning_rate must be .*schedule"),
        ({"learning_rate": "lin_-1"}, "learning_rate must be"),
        ({"gamma": "lin_0.9"}, "gamma must be"),
        ({"n_steps": 0}, "n_steps must be a whole number"),
        ({"n_steps": 2.5}, "n_steps must be a whole number"),
        ({"n_steps": True}, "n_steps must be a whole number"),
        ({"n_timesteps": None}, "n_timesteps must be a whole number"),
        ({"n_timesteps": "1e6"}, r"write 1.0e\+6"),
        ({"ent_coef": float("nan")}, "ent_coef must be"),
        ({"max_grad_norm": 0}, "max_grad_norm must be"),
        ({"normalize_advantage": "yes"}, "normalize_advantage must be true or false"),
        ({"policy": "TeamPolicy"}, "policy is unknown value 'TeamPolicy': allowed are RolePolicy"),
        ({"policy_kwargs": {"grph": True}}, "unknown key in policy_kwargs 'grph'.*'graph'"),
        ({"policy_kwargs": {"norm_layer": "group_"}}, "did you mean 'group'"),
        ({"policy_kwargs": {"role_arch": [8, 0]}}, "policy_kwargs.role_arch entry must be"),
        ({"policy_kwargs": {"optimizer_kwargs": {"fuse": 1}}}, "did you mean 'fused'"),
        ({"policy_kwargs": 3}, "policy_kwargs must be keys and values"),
        ({"env_kwargs": {"scene": "hrad"}}, "did you mean 'hard'"),
        ({"env_kwargs": {"sub_goal": "assignd"}}, "did you mean 'assigned'"),
        ({"env_kwargs": {"horizn": 5}}, "unknown key in env_kwargs 'horizn'.*'horizon'"),
        ({"env_kwargs": {"n_agents": 0}}, "n_agents must be a whole number from 1 to 1024"),
        ({"env_kwargs": {"n_targets": 600}}, "n_targets must be between 1 and the 375"),
        ({"wrapper_kwargs": {"role_evry": 5}}, "did you mean 'role_every'"),
        ({"wrapper_kwargs": {"roles": ["explore", "covr"]}}, "did you mean 'cover'"),
        ({"wrapper_kwargs": {"role_weights": {"explor": 1}}}, "did you mean 'explore'"),
        ({"wrapper_kwargs": {"primitive_weights": "identty"}}, "did you mean 'identity'"),
        (
            {"wrapper_kwargs": {"primitive_weights": {"explore": {}, "cover": {"x": 1}}}},
            "primitive_weights.cover: unknown reward component 'x'",
        ),
        ({"n_steps": 10, "batch_size": 1000}, "batch_size must be at most n_steps x n_envs"),
        ({"policy": ["RolePolicy"]}, "policy is unknown value"),
        ({"wrapper_kwargs": {"roles": [1], "role_control": "explore"}}, "roles entry|role_control"),
        ({"vec_env": "native"}, "vec_env is no hyperparameter: give --vec-env"),
        (
            {"policy_kwargs": {"communication_radius": 5}},
            "policy_kwargs.communication_radius must be the environment's, 10, got 5",
        ),
        (
            {"policy_kwargs": {"communication_radius": None}},
            "communication_radius must be the environment's, 10, got None",
        ),
        ({"env_kwargs": {"reward_sharing": "same_role"}}, "wrapper_kwargs.reward_sharing shares"),
        ({"env_kwargs": {"alpha": 0.3}}, "env_kwargs.alpha weighs nothing.*role_weights"),
    ],
)
def test_problems(settings, expected):
    found = lines(**settings)
    if "roles" not in settings.get("wrapper_kwargs", {}):
        assert len(found) == 1
    assert re.search(expected, found[0]), found[0]


def test_a_file_does_not_choose_the_environment():
    with pytest.raises(ConfigError, match="env is no hyperparameter: give --env"):
        resolve("hmappo", ENV, {**GOOD, "env": "subprocess:Popen"})


def test_all_problems_at_once():
    found = lines(gama=1, n_steps=0, env_kwargs={"scene": "x"}, policy_kwargs={"y": 1})
    assert len(found) == 4


def test_rules_of_single_algorithms():
    assert "has no roles" in lines("mappo", wrapper_kwargs={"role_every": 2})[0]
    assert "must be 1" in lines("recurrent_ppo", wrapper_kwargs={"role_every": 2})[0]
    assert "did you mean 'hmappo'" in lines("hmapo")[0]
    assert "did you mean 'area-search-v0'" in lines(env="area-serch-v0")[0]
    with pytest.raises(ValueError, match="did you mean 'ppo'"):
        get_algorithm("pp0")


def test_the_environment_gives_the_radius_of_the_graph():
    for algo, env_kwargs, expected in [
        ("hmappo", {}, 10.0),
        ("mappo", {"communication_radius": 3}, 3.0),
        ("ppo", {"communication_radius": 0.5}, 0.5),
    ]:
        config = resolve(algo, ENV, {**GOOD, "env_kwargs": env_kwargs})
        assert config["policy_kwargs"] == {"communication_radius": expected}
        # What was written is read again.
        assert resolve(algo, ENV, {key: config[key] for key in GOOD | {"env_kwargs": 0,
                       "policy_kwargs": 0}}) == config  # fmt: skip
        model = make_model({**config, "n_envs": 1}, make_env(config, 1), "cpu")
        assert model.policy.communication_radius == expected
    # These have no graph, and others' environments no radius.
    assert resolve("maskable_ppo", ENV, GOOD)["policy_kwargs"] == {}
    assert resolve("hmappo", "some:factory", GOOD)["policy_kwargs"] == {}


def test_rewards_are_shared_once():
    """Without roles the environment shares, with roles the wrapper does."""
    settings = {**GOOD, "env_kwargs": {"reward_sharing": "same_role", "alpha": 0.3, "beta": 0.7}}
    assert resolve("mappo", ENV, settings)["env_kwargs"]["alpha"] == 0.3
    assert len(lines("ppo", env_kwargs=settings["env_kwargs"])) == 3


def test_seeds_are_no_aliases():
    biggest = 2**32 - 1
    assert resolve("mappo", ENV, GOOD, seed=biggest)["seed"] == biggest
    with pytest.raises(ConfigError, match=r"seed must be .* \[0, 4294967295\], got 4294967296"):
        resolve("mappo", ENV, GOOD, seed=biggest + 1)


def test_identity_of_a_run(tmp_path):
    file = tmp_path / "config.yml"
    config = resolve("mappo", "some:factory", GOOD, 7, "supersuit")
    write_yaml(file, config)
    identity = {"algo": "mappo", "env": "some:factory", "seed": 7, "vec_env": "supersuit"}
    assert load_identity(file) == identity
    assert load_settings("mappo", "some:factory", file).keys() == config.keys() - identity.keys()
    assert load_identity(FILES_BY_NAME["hmappo_paper"]) == {}
    for key, wrong in [("algo", "mapo"), ("algo", ["mappo"]), ("env", 3), ("seed", "x"),
                       ("seed", -1), ("vec_env", {})]:  # fmt: skip
        write_yaml(file, {**config, key: wrong})
        with pytest.raises(ConfigError, match=rf"config.yml: {key} "):
            load_identity(file)


def test_a_manifest_may_say_anything():
    for said, steps in [({}, 0), ({"env_steps": 3}, 3)]:
        assert steps_of(Checkpoint(said, {}, {}, {}), "env_steps") == steps
    for wrong in ("3", -1, 2.5, [1], None):
        with pytest.raises(CheckpointError, match="damaged checkpoint: env_steps is"):
            steps_of(Checkpoint({"env_steps": wrong}, {}, {}, {}), "env_steps")


def test_code_is_named_by_the_user():
    check_named("run", ENV, None)
    check_named("run", ENV, ENV)
    check_named("run", "a:b", "a:b")
    with pytest.raises(UsageError, match=r"run: its environment is code.*add --env a:b"):
        check_named("run", "a:b", None)
    for named in ("a:c", ENV):
        with pytest.raises(UsageError, match="its environment is a:b, not"):
            check_named("run", "a:b", named)


def test_numbers():
    assert yaml_number("1e6") == "1.0e+6"
    assert yaml_number("5e-4") == "5.0e-4"
    assert yaml_number("2.5E3") == "2.5e+3"
    assert yaml_number("hard") is None
    assert yaml.safe_load(yaml_number("1e6")) == 1e6
    assert Number(0, 1, above=True).problem(0) is not None
    assert Number(0, 1, optional=True).problem(None) is None
    assert Number(schedule=True).problem("lin_5e-4") is None
    assert Whole(1, 5).problem(6) == "must be a whole number in [1, 5], got 6"


def test_schedules_and_batches_are_converted_once():
    config = resolve("ppo", ENV, {**GOOD, "learning_rate": "lin_1.0e-3", "batch_size": 6,
                                  "n_steps": 8})  # fmt: skip
    arguments = ALGORITHMS["ppo"].arguments(config, n_agents=4)
    assert arguments["batch_size"] == 24
    assert arguments["learning_rate"](1.0) == 1e-3
    assert arguments["learning_rate"](0.25) == pytest.approx(2.5e-4)
    assert arguments["learning_rate"](0.0) == pytest.approx(0.0)
    config = resolve("mappo", ENV, {**GOOD, "batch_size": 6, "n_steps": 8})
    assert ALGORITHMS["mappo"].arguments(config, n_agents=4)["batch_size"] == 6


def test_merge():
    merged = merge({"gamma": 1, "env_kwargs": {"a": 1, "b": 2}}, {"env_kwargs": {"b": 3}, "x": 4})
    assert merged == {"gamma": 1, "env_kwargs": {"a": 1, "b": 3}, "x": 4}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [", "not valid YAML"),
        ("- 1", "must be keys and values"),
        ("other-env: {}", "unknown environment 'area-search-v0'"),
        ("default: 3", "must be keys and values"),
        ("1: {}", "unknown environment 'area-search-v0'"),
        ("default: !!python/object/apply:os.system [echo]", "not valid YAML"),
        ("a: \xff", "not valid YAML"),
    ],
)
def test_bad_files(tmp_path, text, expected):
    file = tmp_path / "x.yml"
    file.write_text(text, encoding="latin-1")
    with pytest.raises(ConfigError, match=expected):
        load_settings("hmappo", ENV, file)
    with pytest.raises(ConfigError, match="No such file"):
        load_settings("hmappo", ENV, tmp_path / "none.yml")


@pytest.mark.parametrize(
    ("env", "expected"),
    [
        ("no_such_module_:make", "ModuleNotFoundError"),
        ("toy_envs:nothing", "unknown factory of toy_envs 'nothing': allowed are "),
        ("area_search:AreaSearchEvn", "allowed are SCENES, .* did you mean 'AreaSearchEnv'"),
        ("lazy_:make", "No module named .no_such_package_"),
        ("builtins:dict", "must make a pettingzoo.ParallelEnv"),
        ("builtins:int", "fails|must make"),
    ],
)
def test_bad_factories(env, expected, monkeypatch):
    lazy = ModuleType("lazy_")
    lazy.__getattr__ = lambda name: import_module("no_such_package_")
    monkeypatch.setitem(sys.modules, "lazy_", lazy)
    with pytest.raises(UsageError, match=expected):
        env_factory(env, {"x": 1})


def test_the_environment_that_is_tried_is_closed(monkeypatch):
    closed = []
    monkeypatch.setattr(toy_envs.PlainEnv, "close", lambda self: closed.append(self))
    make = env_factory("toy_envs:PlainEnv", {"horizon": 3})
    assert len(closed) == 1
    assert make().horizon == 3
    assert len(closed) == 1


def test_no_torch_before_the_configuration_is_checked():
    code = (
        "import sys; from sb3_roles.zoo import train, config; "
        "config.resolve('hmappo', 'area-search-v0', config.load_settings('hmappo', "
        "'area-search-v0')); print({'torch', 'numba', 'pettingzoo'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True,
                            env={"PYTHONPATH": f"{ROOT / 'envs'}:{ROOT}"}, timeout=60)  # fmt: skip
    assert result.stdout.strip() == "set()", result.stderr
