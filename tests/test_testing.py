"""The public checks: silent where all is well, and clear where a bug is planted."""

from __future__ import annotations

import copy
import functools
import importlib
import warnings
from typing import ClassVar

import numpy as np
import pytest
import toy_envs
from gymnasium import spaces
from helpers import one_line

import sb3_roles.testing as checks
from sb3_roles.common.buffers import TeamRolloutBuffer
from sb3_roles.common.losses import lambda_returns, stream_loss
from sb3_roles.prove import planted_environments as planted
from sb3_roles.prove.planted import BUGS, RIGHT, finding, found_by_pettingzoo
from sb3_roles.testing.episodes import play

N_STEPS = 30
# Each check, and what it catches alone: planted bug, and words of the message.
CAUGHT_BY = {
    "check_spaces": (planted.OutOfBounds, ["'robot_1'", "step 5", "0.0 to 8.0"]),
    "check_finite": (planted.NotANumber, ["'robot_2'", "step 5", "nan"]),
    "check_dtypes_and_shapes": (planted.OtherDtype, ["'robot_0'", "step 1", "float32", "float64"]),
    "check_no_aliasing": (planted.Aliased, ["'robot_0'", "reset of episode 0", "has changed"]),
    "check_reset_forgets": (planted.Leaking, ["'robot_0'", "step 1", "reward"]),
    "check_determinism": (planted.Nondeterministic, ["'robot_0'", "step 2", "reward"]),
    "check_agents": (planted.LeftBehind, ["'robot_2'", "step 12", "has ended"]),
    "check_infos": (planted.NoInfo, ["'robot_1'", "reset", "info"]),
    "check_actions_matter": (planted.ActionIgnored, ["'robot_2'", "steps 1 to 30"]),
    "check_batched_equals_single": (planted.BatchDiffers, ["team 0", "'robot_0'", "step 1 "]),
    "check_state_round_trip": (planted.ClockForgotten, ["'robot_0'", "step 12", "truncation"]),
}

NOT_OF_ENVIRONMENTS = {
    "check_returns": lambda_returns,
    "check_stream_loss": stream_loss,
    "check_team_buffer": TeamRolloutBuffer,
}


class StillToy(toy_envs.ToyEnv):
    """The toy of other tests, with observations of its own at each step."""

    def observe(self):
        return {
            agent: {key: value.copy("K") for key, value in observation.items()}
            for agent, observation in super().observe().items()
        }

    def reset(self, seed=None, options=None):
        observations, _ = super().reset(seed)
        return observations, {agent: {} for agent in self.agents}


class SameSeed(planted.SmallSearch):
    def reset(self, seed=None, options=None):
        return super().reset(None if seed is None else 0, options)


class OneDiesEarly(planted.SmallSearch):
    def step(self, actions):
        actions = {agent: actions.get(agent, 0) for agent in self.possible_agents}
        self.agents = list(self.possible_agents)
        result = super().step(actions)
        if self.clock >= 3:
            result[2]["robot_1"] = True
            self.agents = [agent for agent in self.agents if agent != "robot_1"]
        return result


class SharedInfos(planted.SmallSearch):
    def step(self, actions):
        *parts, infos = super().step(actions)
        return *parts, dict.fromkeys(infos, infos["robot_0"])


class NewSpaces(planted.SmallSearch):
    def action_space(self, agent):
        return spaces.Discrete(5)


class Crashing(planted.SmallSearch):
    def step(self, actions):
        if self.clock == 4:
            raise KeyError("robot_9")
        return super().step(actions)


class FourParts(planted.SmallSearch):
    def step(self, actions):
        return super().step(actions)[:4]


class BoolsAsNumbers(planted.SmallSearch):
    def step(self, actions):
        observations, rewards, terminations, truncations, infos = super().step(actions)
        numbers = {agent: int(flag) for agent, flag in truncations.items()}
        return observations, rewards, terminations, numbers, infos


class ReachedByWriting(planted.SmallSearch):
    """Hands out an array, and goes on from it."""

    def reset(self, seed=None, options=None):
        result = super().reset(seed, options)
        self.shown = np.zeros(2, np.float32)
        return result

    def step(self, actions):
        observations, rewards, *rest = super().step(actions)
        self.shown = self.shown + 0.125
        rest[-1]["robot_0"]["shown"] = self.shown
        rewards["robot_0"] += float(self.shown[0])
        return observations, rewards, *rest


class ClassCounts(planted.SmallSearch):
    """Rewards grow with each reset of any instance."""

    resets: ClassVar[int] = 0

    def reset(self, seed=None, options=None):
        ClassCounts.resets += 1
        return super().reset(seed, options)

    def step(self, actions):
        observations, rewards, *rest = super().step(actions)
        rewards = {agent: x + ClassCounts.resets / 10 for agent, x in rewards.items()}
        return observations, rewards, *rest


class ClassMap(planted.SmallSearch):
    """A large array of each reset is that of the next one of any instance, moved on."""

    shared: ClassVar[np.ndarray] = np.zeros(100, np.float32)

    def reset(self, seed=None, options=None):
        ClassMap.shared = ClassMap.shared + 1
        return super().reset(seed, options)

    def step(self, actions):
        *parts, infos = super().step(actions)
        for info in infos.values():
            info["shared"] = ClassMap.shared.copy()
        return *parts, infos


class Unusual(planted.SmallSearch):
    """Infos of what is equal, but not bit for bit, or only to itself."""

    marker: ClassVar[object] = object()
    resets: ClassVar[int] = 0

    def reset(self, seed=None, options=None):
        Unusual.resets += 1
        self.sign = -1.0 if Unusual.resets % 2 else 1.0
        return super().reset(seed, options)

    def step(self, actions):
        *parts, infos = super().step(actions)
        for info in infos.values():
            large = np.full(100, self.sign * 0.0)
            large[0] = self.sign * np.nan
            info.update(large=large, marker=self.marker, none=float("nan"), kinds={8, 0})
        return *parts, infos


class Stateless(planted.SmallSearch):
    get_state = set_state = None


class NoWayBack(planted.SmallSearch):
    set_state = None


class OddState(planted.SmallSearch):
    def get_state(self):
        return {**super().get_state(), "rngs": [object()]}

    def set_state(self, state):
        super().set_state({key: value for key, value in state.items() if key != "rngs"})


class LiveState(toy_envs.PlainEnv):
    """Its state is what it goes on to write into, and what it is given as well."""

    def reset(self, seed=None, options=None):
        result = super().reset(seed, options)
        self.total = np.zeros(1)
        return result

    def step(self, actions):
        self.total += sum(actions.values())
        return super().step(actions)

    def get_state(self):
        return {
            "total": self.total,
            "clock": self.clock,
            "agents": list(self.agents),
            "rng": self.rng.bit_generator.state,
        }

    def set_state(self, state):
        self.total, self.clock, self.agents = state["total"], state["clock"], state["agents"]
        self.rng.bit_generator.state = state["rng"]


class CopiedState(LiveState):
    def get_state(self):
        return copy.deepcopy(super().get_state())


def said(check, *arguments, **options):
    """What a check says of what it refuses."""
    with pytest.raises(checks.ConformanceError) as caught:
        check(*arguments, **options)
    return one_line(caught.value)


@pytest.mark.parametrize("name", CAUGHT_BY)
def test_a_check_finds_its_bug_alone_and_names_agent_and_step(name):
    check, (bug, words) = getattr(checks, name), CAUGHT_BY[name]
    check(planted.SmallSearch, n_steps=N_STEPS)
    message = said(check, bug, n_steps=N_STEPS)
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("check", "bug", "words"),
    [
        (checks.check_dtypes_and_shapes, planted.OtherShape, ["'robot_0'", "(2,)", "(1, 2)"]),
        (checks.check_finite, planted.RewardArray, ["'robot_0'", "step 1", "number"]),
        (checks.check_agents, BoolsAsNumbers, ["'robot_0'", "step 1", "bool"]),
        (checks.check_agents, Crashing, ["step 5 of episode 0", "KeyError", "robot_9"]),
        (checks.check_agents, FourParts, ["step 1", "5 dicts", "4 values"]),
        (checks.check_agents_live_together, OneDiesEarly, ["'robot_1'", "step 3", "together"]),
        (checks.check_infos, SharedInfos, ["'robot_1'", "step 1", "'robot_0'"]),
        (checks.check_spaces, NewSpaces, ["action_space", "same object"]),
        (checks.check_seed_matters, SameSeed, ["seeds 0 to 7"]),
        (checks.check_no_aliasing, ReachedByWriting, ["'robot_0'", "step 2", "writing into"]),
    ],
)
def test_further_bugs(check, bug, words):
    message = said(check, bug, n_steps=N_STEPS)
    assert all(word in message for word in words), message


def test_ends():
    checks.check_episode_ends(planted.SmallSearch, horizon=12)
    checks.check_episode_ends(planted.SmallSearch, max_episode_steps=12)
    message = said(checks.check_episode_ends, planted.Endless, max_episode_steps=30)
    assert "'robot_0', step 30 of episode 0" in message and "within 30 steps" in message
    message = said(checks.check_episode_ends, planted.HorizonTerminates, horizon=12)
    assert "step 12" in message and "expected a truncation" in message
    assert "step 5" in said(checks.check_episode_ends, planted.SmallSearch, horizon=5)


@pytest.mark.parametrize("horizon", [13, 200])
def test_a_truncation_before_the_horizon_is_refused(horizon):
    for check in (checks.check_episode_ends, checks.check_parallel_env):
        message = said(check, planted.SmallSearch, horizon=horizon)
        assert "'robot_0', step 12 of episode 0: truncated before the horizon" in message
        assert f"{horizon} steps" in message


def test_a_termination_before_the_horizon_is_fine():
    def make():
        return planted.AreaSearchEnv(
            height=9, width=9, n_targets=8, n_agents=3, horizon=40, early_stop_patience=3
        )

    ends = [m for m in play(make(), 40, 0) if m.step and not m.after]
    assert ends and all(m.step < 40 and not any(m.truncation.values()) for m in ends)
    checks.check_episode_ends(make, horizon=40)


@pytest.mark.parametrize("check", [checks.check_determinism, checks.check_reset_forgets])
def test_state_of_the_class_is_found(check):
    message = said(check, ClassCounts, n_steps=N_STEPS)
    assert "'robot_0', step 1 of episode 0: reward is" in message
    assert "expected to be equal" in message and "share state, in the class" in message
    message = said(check, ClassMap, n_steps=N_STEPS)
    assert "info['shared'] is float32 (100,) with the digest" in message and "class" in message
    check(Unusual, n_steps=N_STEPS)


def test_an_instance_is_no_function_that_makes_one():
    env = planted.SmallSearch()
    for name in set(checks.__all__) - {"ConformanceError", *NOT_OF_ENVIRONMENTS}:
        with pytest.raises(TypeError, match="instance of SmallSearch: give SmallSearch, or") as one:
            getattr(checks, name)(env)
        assert "make_env must be" in one_line(one.value)
    with pytest.raises(TypeError, match=r"instance of NoneType$"):
        checks.check_parallel_env(None)


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        *(
            (name, options, words)
            for name in checks.__all__
            if name.startswith("check_") and name != "check_episode_ends"
            for options, words in [
                ({"n_steps": 0}, "n_steps must be a whole number of at least 1, got 0"),
                ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
            ]
            if name not in NOT_OF_ENVIRONMENTS or "seed" in options
        ),
        ("check_episode_ends", {"seed": 0.5}, "seed must be"),
        ("check_episode_ends", {"n_episodes": 0}, "n_episodes must be"),
        ("check_episode_ends", {"horizon": 0}, "horizon must be .* at least 1, got 0"),
        ("check_episode_ends", {"max_episode_steps": 0}, "max_episode_steps must be"),
        ("check_seed_matters", {"n_seeds": 1}, "n_seeds must be .* at least 2, got 1"),
        ("check_actions_matter", {"n_tries": 0}, "n_tries must be"),
        ("check_batched_equals_single", {"n_teams": 0}, "n_teams must be"),
        ("check_returns", {"n_rollouts": 0}, "n_rollouts must be"),
        ("check_stream_loss", {"n_batches": 0}, "n_batches must be"),
        ("check_team_buffer", {"steps": 0}, "steps must be"),
        ("check_team_buffer", {"batches": ()}, r"len\(batches\) must be"),
    ],
)
def test_numbers_that_are_not_allowed_are_named(name, options, words):
    with pytest.raises(ValueError, match=words) as caught:
        getattr(checks, name)(NOT_OF_ENVIRONMENTS.get(name, planted.SmallSearch), **options)
    one_line(caught.value)


def test_numbers_of_numpy_are_allowed():
    checks.check_determinism(planted.SmallSearch, n_steps=np.int64(14), seed=np.int64(2))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("myenvs", "module:name.*, got 'myenvs'"),
        (":Good", "module:name.*, got ':Good'"),
        ("no_such_module:Good", "'no_such_module:Good' can not be imported: ModuleNotFoundError"),
        ("toy_envs:Good", "'toy_envs:Good' can not be imported: AttributeError"),
    ],
)
def test_names_that_can_not_be_imported(name, words):
    with pytest.raises(ValueError, match=words) as caught:
        checks.check_fresh_process(name)
    one_line(caught.value)


def test_what_an_environment_must_have_for_a_check_is_said():
    with pytest.raises(ValueError, match="get_state and set_state, PlainEnv has neither"):
        checks.check_state_round_trip(toy_envs.PlainEnv)
    with pytest.raises(ValueError, match=r"batched\(n_teams\), which PlainEnv has not"):
        checks.check_batched_equals_single(toy_envs.PlainEnv)
    checks.check_parallel_env(Stateless, N_STEPS)


def test_half_of_the_methods_of_a_state_is_refused():
    for check in (checks.check_state_round_trip, checks.check_parallel_env):
        message = said(check, NoWayBack, n_steps=N_STEPS)
        assert "NoWayBack has get_state alone, expected get_state and set_state" in message


def test_a_state_that_no_checkpoint_can_store_is_refused():
    for check in (checks.check_state_round_trip, checks.check_parallel_env):
        message = said(check, OddState, n_steps=N_STEPS)
        assert message.startswith("get_state after the reset of episode 0: expected what can be")
        assert "arrays of numbers" in message and "state/rngs/0 is a object" in message


def test_a_state_must_be_a_copy():
    checks.check_state_round_trip(CopiedState, n_steps=N_STEPS)
    message = said(checks.check_state_round_trip, LiveState, n_steps=N_STEPS)
    assert "reset of episode 0: get_state must return a copy" in message
    assert "state['total'][0] is 0.0 and" in message


def test_comparisons_say_what_was_expected():
    for name in ("check_determinism", "check_reset_forgets", "check_batched_equals_single"):
        message = said(getattr(checks, name), CAUGHT_BY[name][0], n_steps=N_STEPS)
        assert ", expected to be equal" in message


def test_a_new_process_plays_the_same_unless_hashes_matter():
    checks.check_fresh_process(toy_envs.PlainEnv, n_steps=15)
    message = said(checks.check_fresh_process, "toy_envs:HashedEnv", n_steps=5)
    assert "step 1 of episode 0" in message and "hash()" in message
    with pytest.raises(ValueError, match="can not import"):
        checks.check_fresh_process(lambda: planted.SmallSearch(), n_steps=5)


def test_environments_without_bugs_pass():
    checks.check_parallel_env(planted.SmallSearch, N_STEPS, horizon=12)
    checks.check_parallel_env(StillToy, N_STEPS)
    message = said(checks.check_parallel_env, toy_envs.ToyEnv, N_STEPS)
    assert "'robot_0', reset of episode 0" in message and "has changed" in message


@pytest.mark.parametrize(
    ("module", "options"),
    [
        ("classic.rps_v2", {"n_steps": 40, "has_chance": False}),
        ("butterfly.cooperative_pong_v6", {"n_steps": 3}),
    ],
)
def test_environments_of_pettingzoo(module, options):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            env = importlib.import_module(f"pettingzoo.{module}")
        except ImportError as error:
            pytest.skip(str(error))
        if module.startswith("classic"):
            checks.check_parallel_env(env.parallel_env, **options)
            return
        # Pictures, so few steps; its two paddles share one info.
        for name in ("spaces", "finite", "dtypes_and_shapes", "no_aliasing", "determinism"):
            getattr(checks, f"check_{name}")(env.parallel_env, **options)
        assert "same object" in said(checks.check_infos, env.parallel_env, **options)


@pytest.mark.parametrize("bug", BUGS, ids=[f"{bug.kind}: {bug.name}" for bug in BUGS])
def test_every_planted_bug_is_found_for_another_seed(bug):
    message = bug.found(seed=5)
    assert message is not None
    assert "\n" not in message


@pytest.mark.parametrize("kind", RIGHT)
@pytest.mark.parametrize("seed", [3, 4])
def test_nothing_is_found_in_what_has_no_bug(kind, seed):
    assert finding(kind, RIGHT[kind], seed) is None


def test_pettingzoo_finds_few_of_them():
    assert not found_by_pettingzoo(planted.SmallSearch)
    assert found_by_pettingzoo(planted.LeftBehind)
    assert not found_by_pettingzoo(planted.NotANumber)


# Buffers, returns and losses.


@pytest.mark.parametrize("shape", [(1, 1, 2), (5, 2, 4), (3, 4, 9)])
def test_a_buffer_of_any_size_passes(shape):
    n_teams, n_agents, steps = shape
    checks.check_team_buffer(
        TeamRolloutBuffer, n_teams=n_teams, n_agents=n_agents, steps=steps, batches=(2, 7)
    )


class Relabeled(TeamRolloutBuffer):
    def samples(self, index):
        whole = super().samples(index)
        return whole._replace(actions=whole.actions.roll(1, 0))


def test_a_buffer_that_mixes_up_actions_is_refused():
    message = said(checks.check_team_buffer, Relabeled)
    assert message.startswith("minibatch 0, row") and "the action is not that of agent" in message


def test_returns():
    checks.check_returns(lambda_returns)

    def late(rewards, values, last, ends, gamma, gae_lambda):
        return lambda_returns(rewards, values, last, ends.roll(1, 0), gamma, gae_lambda)

    message = said(checks.check_returns, late)
    assert "step" in message and "row" in message and "expected" in message


def test_losses():
    checks.check_stream_loss(stream_loss, seed=7)

    def whole_only(**arguments):
        arguments.pop("n_active", None)
        return stream_loss(**arguments)

    assert "three parts" in said(checks.check_stream_loss, whole_only)


def test_names_are_there():
    for name in checks.__all__:
        assert getattr(checks, name).__doc__
    with pytest.raises(AttributeError):
        _ = checks.check_everything


def test_functions_with_arguments_can_be_checked():
    make = functools.partial(planted.AreaSearchEnv, height=7, width=7, n_targets=3, n_agents=2)
    checks.check_spaces(make, n_steps=10)
