"""``RoleWrapper``: actions of roles and moves, the rewards of the two levels, lasting roles."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from helpers import SMALL_ROLE, hand_made, one_line, small_search, weights
from toy_envs import BatchedToy, PlainEnv, ToyEnv

from sb3_roles import HMAPPO, RoleWrapper
from sb3_roles.common import roles as registry
from sb3_roles.common.role_rules import NearestRole
from sb3_roles.common.roles import Role, get_roles, register_role
from sb3_roles.common.team_vec_env import make_team_vec_env, team_seeds
from sb3_roles.common.team_wrapper import TeamWrapper
from sb3_roles.evaluation.policies import PolicyController

# Pays for the components of the toy environment.
WALK, COUNT = Role("walk", "move"), Role("count", "team")
WEIGHTS = {"move": 0.4, "team": 0.6}
N_TEAMS, N_AGENTS = 3, BatchedToy.n_agents
ROWS = N_TEAMS * N_AGENTS


def toy(backend="native", expand=True, **options):
    env = make_team_vec_env(ToyEnv, N_TEAMS, 0, backend, expand_team_observations=expand)
    return RoleWrapper(env, **{"roles": (WALK, COUNT), "role_weights": WEIGHTS, **options})


def random_actions(env, observations, rng):
    """Random roles where they are due, the ones that go on elsewhere; random moves."""
    n_roles, n_moves = env.action_space.nvec
    roles = rng.integers(0, n_roles, env.num_envs)
    due = observations["role_due"][:, 0] == 1
    roles = np.where(due, roles, observations["role"].argmax(1))
    return np.stack([roles, rng.integers(0, n_moves, env.num_envs)], axis=1)


def play(env, n_steps=10, seed=0):
    """Yield actions, the environment's own components, and what the wrapper returned."""
    rng = np.random.default_rng(seed)
    observations = env.reset()
    for _ in range(n_steps):
        actions = random_actions(env, observations, rng)
        observations, rewards, dones, infos = env.step(actions)
        yield actions, env.team_env.reward_components, observations, rewards, dones, infos


def test_actions_are_a_role_and_a_move_and_observations_say_who_acts():
    env = toy()
    assert env.action_space == spaces.MultiDiscrete([2, 3])
    observations = env.reset()
    assert set(observations) == {"local", "joint", "vector", "agent", "role", "role_due"}
    assert observations["agent"].tolist() == [[i, N_AGENTS] for i in range(N_AGENTS)] * N_TEAMS
    assert not observations["role"].any()
    assert observations["role_due"].all()
    for key, space in env.observation_space.spaces.items():
        assert observations[key].shape == (ROWS, *space.shape)
        assert all(space.contains(row) for row in observations[key])


def test_the_environment_gets_the_moves_and_the_next_observation_the_roles():
    for actions, components, observations, _, dones, _ in play(toy()):
        np.testing.assert_array_equal(components[:, 0], actions[:, 1])
        expected = np.eye(2)[actions[:, 0]] * ~dones[:, None]
        np.testing.assert_array_equal(observations["role"], expected)


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_the_role_reward_is_the_weighted_sum_of_the_components(backend):
    env = toy(backend)
    for _, components, _, rewards, _, _ in play(env):
        expected = 0.4 * components[:, 0] + 0.6 * components[:, 1]
        np.testing.assert_allclose(rewards, expected, rtol=1e-6)
        np.testing.assert_allclose(env.stream_rewards[:, 0], expected, rtol=1e-6)
        assert rewards.dtype == env.stream_rewards.dtype == np.float32


FREE = {"walk": {"move": 2.0, "team": -1.0}, "count": {"team": 0.5}}
MATRICES = {
    "identity": [[1.0, 0.0], [0.0, 1.0]],
    "role_reward": [[0.4, 0.6], [0.4, 0.6]],
    "free": [[2.0, -1.0], [0.0, 0.5]],
}


@pytest.mark.parametrize("name", MATRICES)
def test_the_primitive_reward_is_paid_by_the_role_s_row_of_the_matrix(name):
    env = toy(primitive_weights=FREE if name == "free" else name)
    matrix = np.array(MATRICES[name])
    for actions, components, *_ in play(env):
        expected = (matrix[actions[:, 0]] * components).sum(axis=1)
        np.testing.assert_allclose(env.stream_rewards[:, 1], expected, rtol=1e-5, atol=1e-6)


def shared_by_hand(sharing, roles, components):
    """What each row's components sum up to, robot by robot."""
    out = np.zeros_like(components)
    for row in range(ROWS):
        team = row // N_AGENTS
        for other in range(team * N_AGENTS, (team + 1) * N_AGENTS):
            if (
                sharing == "team"
                or other == row
                or (sharing == "same_role" and roles[other] == roles[row])
            ):
                out[row] += components[other]
    return out


@pytest.mark.parametrize("sharing", ["own", "same_role", "team"])
def test_components_are_shared_within_the_team(sharing):
    env = toy(reward_sharing=sharing)
    mixed = 0
    for actions, components, _, rewards, _, _ in play(env):
        shared = shared_by_hand(sharing, actions[:, 0], components)
        np.testing.assert_allclose(rewards, shared @ [0.4, 0.6], rtol=1e-5)
        np.testing.assert_allclose(
            env.stream_rewards[:, 1], shared[np.arange(ROWS), actions[:, 0]], rtol=1e-5
        )
        by_team = actions[:, 0].reshape(N_TEAMS, N_AGENTS).sum(axis=1)
        mixed += ((by_team > 0) & (by_team < N_AGENTS)).sum()
    assert mixed > 10


def test_the_printed_rewards_of_area_search():
    # Eq. 2 with alpha 0.4 and Eq. 6: R_e for explorers, R_c for coverers, summed over same roles.
    env = small_search(roles={"role_weights": {"explore": 0.4, "cover": 0.6}})
    shared = small_search(roles={"reward_sharing": "same_role"})
    rng = np.random.default_rng(0)
    env.reset(), shared.reset()
    paid = np.zeros(2)
    for _ in range(20):
        actions = np.stack([rng.integers(0, n, env.num_envs) for n in (2, 5)], axis=1)
        rewards = env.step(actions)[1]
        shared.step(actions)
        components = env.team_env.reward_components
        paid += components.sum(axis=0)
        role = actions[:, 0]
        own = components[np.arange(env.num_envs), role]
        np.testing.assert_allclose(rewards, components @ [0.4, 0.6], rtol=1e-6)
        np.testing.assert_allclose(env.stream_rewards[:, 1], own, rtol=1e-6)
        team = role.reshape(-1, 3)
        same = (team[:, :, None] == team[:, None, :]).astype(float)
        expected = (same @ own.reshape(-1, 3, 1)).ravel()
        np.testing.assert_allclose(shared.stream_rewards[:, 1], expected, rtol=1e-5)
    assert (paid > 0).all()


def test_an_environment_without_components_pays_its_reward_for_every_role():
    env = RoleWrapper(make_team_vec_env(PlainEnv, 2, 0))
    env.reset()
    actions = np.array([[0, 1], [1, 1], [1, 0], [0, 1]])
    observations, rewards, _, _ = env.step(actions)
    assert rewards.tolist() == [1.0, 1.0, 0.0, 1.0]
    assert env.stream_rewards.tolist() == [[r, r] for r in rewards]
    assert set(observations) == {"observation", "agent", "role", "role_due"}


class LongToy(ToyEnv):
    def __init__(self):
        super().__init__()
        self.toy.horizon = 7

    def batched(self, n_teams):
        batched = BatchedToy(n_teams)
        batched.horizon = 7
        return batched


def test_a_role_lasts_role_every_steps_of_an_episode():
    env = RoleWrapper(make_team_vec_env(LongToy, N_TEAMS, 0), roles=(WALK, COUNT), role_every=3)
    clock = np.zeros(ROWS, int)
    last_roles = None
    ends = 0
    for actions, _, observations, _, dones, infos in play(env, 40):
        held = clock % 3 != 0
        if last_roles is not None:
            assert (actions[held, 0] == last_roles[held]).all()
        last_roles = actions[:, 0]
        for row in np.flatnonzero(dones):
            terminal = infos[row]["terminal_observation"]
            assert terminal["role_due"] == [(clock[row] + 1) % 3 == 0]
        clock = np.where(dones, 0, clock + 1)
        ends += dones.sum()
        np.testing.assert_array_equal(observations["role_due"][:, 0], clock % 3 == 0)
    assert ends > 3 * N_AGENTS


def test_a_role_that_goes_on_cannot_be_changed():
    env = toy(role_every=2)
    env.reset()
    actions = np.zeros((ROWS, 2), int)
    _, _, dones, _ = env.step(actions)
    row = int(np.flatnonzero(~dones)[-1])
    actions[row, 0] = 1
    with pytest.raises(ValueError, match=f"row {row} acts in role 1, but its role 0 goes on"):
        env.step(actions)


@pytest.mark.parametrize("bad", [2, -1])
def test_a_role_that_does_not_exist_is_refused(bad):
    env = toy()
    env.reset()
    actions = np.zeros((ROWS, 2), int)
    actions[4, 0] = bad
    with pytest.raises(ValueError, match="role"):
        env.step(actions)


@pytest.mark.parametrize("shape", [(ROWS,), (ROWS, 3), (ROWS - 1, 2)])
def test_actions_of_another_shape_are_refused(shape):
    env = toy()
    env.reset()
    with pytest.raises(ValueError, match="actions"):
        env.step(np.zeros(shape, int))


def test_a_fixed_role_is_given_and_never_due():
    env = toy(role_control="count")
    observations = env.reset()
    for _ in range(9):
        assert (observations["role"] == [0, 1]).all()
        assert not observations["role_due"].any()
        actions = np.stack([np.ones(ROWS, int), np.zeros(ROWS, int)], axis=1)
        observations, *_ = env.step(actions)
        np.testing.assert_allclose(
            env.stream_rewards[:, 1], env.team_env.reward_components[:, 1], rtol=1e-6
        )
    with pytest.raises(ValueError, match="goes on"):
        env.step(np.zeros((ROWS, 2), int))


def random_roles(env, n_steps):
    """Play in the roles that are given; return them, (n_steps, rows), and each step's clock."""
    observations, clock = env.reset(), np.zeros(env.num_envs, int)
    given, clocks = [], []
    for _ in range(n_steps):
        assert not observations["role_due"].any()
        assert (observations["role"].sum(axis=1) == 1).all()
        roles = observations["role"].argmax(axis=1)
        given.append(roles)
        clocks.append(clock)
        actions = np.stack([roles, np.ones_like(roles)], axis=1)
        observations, _, dones, _ = env.step(actions)
        clock = np.where(dones, 0, clock + 1)
    return np.array(given), np.array(clocks)


def test_random_roles_are_uniform_and_last_role_every_steps():
    env = toy(role_control="random", role_every=2)
    env.seed(5)
    roles, clocks = random_roles(env, 400)
    held = clocks[1:] % 2 == 1
    assert (roles[1:][held] == roles[:-1][held]).all()
    drawn = roles[clocks % 2 == 0]
    # Five standard deviations of a fair coin.
    assert abs(drawn.mean() - 0.5) < 5 * 0.5 / np.sqrt(drawn.size)
    again, other = (toy(role_control="random", role_every=2) for _ in range(2))
    again.seed(5)
    other.seed(6)
    again, other = random_roles(again, 400)[0], random_roles(other, 400)[0]
    np.testing.assert_array_equal(roles, again)
    assert (roles != other).any()


def test_seeding_the_environment_repeats_its_random_roles():
    env = toy(role_control="random")
    env.seed(3)
    first = random_roles(env, 6)[0]
    env.seed(3)
    np.testing.assert_array_equal(first, random_roles(env, 6)[0])


def at_the_end(env, n_steps):
    """Play in the roles that are given; yield row, clock, its role before, its last observation."""
    observations, clock = env.reset(), np.zeros(env.num_envs, int)
    for _ in range(n_steps):
        roles = observations["role"].argmax(axis=1)
        observations, _, dones, infos = env.step(np.stack([roles, roles], axis=1))
        clock += 1
        for row in np.flatnonzero(dones):
            last = infos[row]["terminal_observation"]
            assert last["role"].sum() == 1 and last["role_due"] == [0]
            yield row, clock[row], roles[row], last
        clock[dones] = 0


@pytest.mark.parametrize("role_every", [1, 3])
@pytest.mark.parametrize("sub_goal", ["nearest", "assigned", "routes", "role_routes"])
def test_the_last_observation_has_the_role_that_the_rule_would_give_next(sub_goal, role_every):
    options = {"role_control": "nearest", "role_every": role_every}
    env = small_search(sub_goal=sub_goal, roles=options, early_stop_patience=3)
    rule = NearestRole(env.roles, env.team_env.goal_nearness)
    decided, changed = 0, 0
    for _, clock, before, last in at_the_end(env, 60):
        expected = before
        if clock % role_every == 0:
            expected = rule({"sub_goal": last["sub_goal"][None]})[0]
            decided += 1
            changed += expected != before
        assert last["role"].argmax() == expected
    assert decided > changed > 0


@pytest.mark.parametrize("role_every", [1, 5, 6])
def test_the_last_observation_has_the_random_role_of_the_coming_step(role_every):
    options = {"role_control": "random", "role_every": role_every}
    ends = list(at_the_end(small_search(roles=options, horizon=10, n_teams=8), 10))
    assert len(ends) == 24
    # Where the episode goes on, that step is played.
    longer = random_roles(small_search(roles=options, horizon=11, n_teams=8), 11)[0]
    assert [last["role"].argmax() for *_, last in ends] == longer[10].tolist()
    changed = sum(last["role"].argmax() != before for _, _, before, last in ends)
    assert (changed > 0) == (role_every != 6)


@pytest.mark.parametrize("backend", ["native", "supersuit"])
@pytest.mark.parametrize("expand", [True, False])
def test_last_observations_have_the_keys_of_all_others(backend, expand):
    env = toy(backend, expand, role_every=2)
    seen = 0
    for actions, _, _, _, dones, infos in play(env, 8):
        for row in np.flatnonzero(dones):
            terminal = infos[row]["terminal_observation"]
            assert set(terminal) == set(env.observation_space.spaces)
            assert terminal["agent"].tolist() == [row % N_AGENTS, N_AGENTS]
            assert terminal["role"].tolist() == np.eye(2)[actions[row, 0]].tolist()
            assert env.observation_space.contains(terminal)
            seen += 1
    assert seen >= ROWS


def test_an_observation_that_is_no_dict_becomes_one_also_at_the_end():
    env = TeamWrapper(make_team_vec_env(PlainEnv, 2, 0))
    env.reset()
    for _ in range(5):
        _, _, dones, infos = env.step(np.zeros(4, int))
    assert dones.all()
    terminal = infos[3]["terminal_observation"]
    assert terminal["agent"].tolist() == [1, 2]
    assert terminal["observation"].shape == (3,)


@pytest.mark.parametrize("control", ["learned", "random"])
def test_the_wrapper_goes_on_from_its_state(control):
    rng = np.random.default_rng(1)
    env, other = (toy(role_control=control, role_every=3) for _ in range(2))
    other._role_seeds += np.uint64(1)  # the same episodes, other random roles
    observations = env.reset()
    other.reset()
    for _ in range(3):
        actions = random_actions(env, observations, rng)
        observations, *_ = env.step(actions)
        actions[:, 0] = other._extra_observations()["role"].argmax(1) * (control == "random")
        other.step(actions)
    saved = env.get_state()
    kept = {key: np.copy(value) for key, value in saved.items()}
    keys = ("role", "role_due")
    expected = []
    before = [(t.position.copy(), t.clock.copy()) for t in (env.venv.batched,)]
    for _ in range(3):
        observations, *_ = env.step(random_actions(env, observations, np.random.default_rng(0)))
        expected.append([observations[key].copy() for key in keys])
    # Stepping on did not change what was saved.
    assert all((saved[key] == kept[key]).all() for key in kept)
    (other.venv.batched.position, other.venv.batched.clock) = before[0]
    other.set_state(saved)
    observations = other._extra_observations()
    for step in expected:
        observations, *_ = other.step(random_actions(other, observations, np.random.default_rng(0)))
        for key, value in zip(keys, step, strict=True):
            np.testing.assert_array_equal(observations[key], value)


# Roles by a rule: the nearest goal, on hand-made maps (see ``helpers.SYMBOLS``).

RULE_MAPS = {
    # Frontier cells are explored, free, and beside an unexplored cell.
    "a target is nearer": (["0T..?"], ["cover"]),
    "the frontier is nearer": (["?.0..T"], ["explore"]),
    "a tie is for the target": (["?..0.T"], ["cover"]),
    "the wall makes the target far": (["?.0#T", "#...."], ["explore"]),
    "no target is known": (["0...?"], ["explore"]),
    "no frontier is left": (["0...T"], ["cover"]),
    "each robot for itself": (["0T.....1.?"], ["cover", "explore"]),
}


@pytest.mark.parametrize("name", RULE_MAPS)
@pytest.mark.parametrize("names", [("explore", "cover"), ("cover", "explore")])
def test_the_nearest_goal_makes_the_role(name, names):
    rows, expected = RULE_MAPS[name]
    batch = hand_made(rows, sub_goal="nearest")
    rule = NearestRole(get_roles(names), batch.goal_nearness)
    assert rule.keys == ("sub_goal",)
    seen = batch.observations["sub_goal"].reshape(batch.n_agents, 2, -1)
    assert [names[k] for k in rule({"sub_goal": seen})] == expected


def by_nearness(sub_goal):
    """The rule, written out: the target unless the frontier is nearer."""
    # Routes in roles, which are no goals, come before the goals.
    frontier, target = (2, 3) if sub_goal.shape[1] == 5 else (0, 1)
    return np.where(sub_goal[:, frontier, 5] > sub_goal[:, target, 5], 0, 1)


@pytest.mark.parametrize("sub_goal", ["nearest", "assigned", "routes", "role_routes"])
@pytest.mark.parametrize("backend", ["native", "supersuit"])
@pytest.mark.parametrize("role_every", [1, 3])
def test_roles_by_the_rule_are_given_and_last(sub_goal, backend, role_every):
    roles = {"role_control": "nearest", "role_every": role_every}
    env = small_search(sub_goal=sub_goal, backend=backend, roles=roles, horizon=8)
    observations, clock, rng = env.reset(), 0, np.random.default_rng(0)
    expected = np.full(env.num_envs, -1)
    seen = set()
    for _ in range(24):
        if clock % role_every == 0:
            expected = by_nearness(observations["sub_goal"])
        np.testing.assert_array_equal(observations["role"], np.eye(2)[expected])
        assert not observations["role_due"].any()
        seen |= set(expected)
        actions = np.stack([expected, rng.integers(0, 5, env.num_envs)], axis=1)
        observations, _, dones, _ = env.step(actions)
        clock = 0 if dones.all() else clock + 1
    assert seen == {0, 1}


@pytest.mark.parametrize("role_every", [1, 3])
@pytest.mark.parametrize("see_sub_goal", [True, False])
def test_episodes_are_played_with_the_roles_of_the_rule(role_every, see_sub_goal):
    roles = {"role_control": "nearest", "role_every": role_every}
    env = small_search(sub_goal="nearest", roles=roles)
    keys = None if see_sub_goal else ["local"]
    policy = {**SMALL_ROLE, "actor_keys": keys, "critic_keys": keys}
    model = HMAPPO("RolePolicy", env, n_steps=10, batch_size=10, policy_kwargs=policy, seed=0)
    controller = PolicyController(model)
    batch = env.team_env.batched
    other = type(batch)(batch.scene, batch.n_teams, "nearest")
    env.seed(4)
    observations = env.reset()
    other.reset([int(seed) for seed in team_seeds(4, batch.n_teams)])
    controller.begin(other)
    for _ in range(9):
        actions, _ = model.predict(observations, deterministic=True)
        moves, _ = controller.predict({})
        np.testing.assert_array_equal(controller.roles.ravel(), actions[:, 0])
        np.testing.assert_array_equal(moves, actions[:, 1])
        observations, *_ = env.step(actions)
        other.step(moves.reshape(other.n_teams, -1))
    # Also for the bare policy, and where it has no environment of its own.
    bare = PolicyController(model.policy, roles)
    bare.begin(other)
    assert bare.roles is not None
    with pytest.raises(RuntimeError, match=r"call begin\(batch\)"):
        alone = PolicyController(model.policy, roles)
        alone.start(1, 3)
        alone.choose({"local": observations["local"][:3]}, np.zeros((3, 3)))


def test_training_with_roles_by_the_rule_moves_the_primitive_policy_only():
    env = small_search(sub_goal="nearest", roles={"role_control": "nearest"})
    model = HMAPPO("RolePolicy", env, n_steps=10, batch_size=10, policy_kwargs=SMALL_ROLE, seed=0)
    before = weights(model)
    model.learn(2 * 10 * env.num_envs)
    moved = {name for name, value in weights(model).items() if not th.equal(value, before[name])}
    assert any(name.startswith("action_net") for name in moved)
    assert not any(name.startswith(("role_net", "role_mlp", "role_graph")) for name in moved)


@pytest.mark.parametrize(
    ("options", "sub_goal", "part"),
    [
        ({}, "none", "needs an environment that declares goal_nearness"),
        ({"roles": (Role("a", "cover", "tarqet"),)}, "nearest", "did you mean 'target'"),
        (
            {"roles": (Role("a", "cover", "target"), Role("b", "explore", "target"))},
            "nearest",
            "'a' and 'b' both head for 'target'",
        ),
    ],
)
def test_the_rule_says_what_it_needs(options, sub_goal, part):
    with pytest.raises(ValueError) as caught:
        small_search(sub_goal=sub_goal, roles={"role_control": "nearest", **options})
    assert part in one_line(caught.value)


class NearEnv(PlainEnv):
    """Declares where its robots see how near their goals are, of which the first wins a tie."""

    goal_nearness = {"far": ("observation", (1,)), "near": ("observation", (0,))}  # noqa: RUF012

    def observation_space(self, agent):
        return spaces.Dict({"observation": super().observation_space(agent)})

    def observe(self):
        values = {"a": [0.0, 0.0, 9.0], "b": [self.clock, 2.0, 9.0]}
        return {a: {"observation": np.array(v, np.float32)} for a, v in values.items()}


def test_other_environments_can_declare_the_nearness_of_goals():
    roles = (Role("stay", "reward", "near"), Role("go", "reward", "far"))
    env = make_team_vec_env(NearEnv, 1, 0)
    env = RoleWrapper(env, roles=roles, role_control="nearest")
    observations, given = env.reset(), []
    for _ in range(4):
        given.append(observations["role"].argmax(axis=1))
        actions = np.stack([given[-1], np.zeros(2, int)], axis=1)
        observations, *_ = env.step(actions)
    # Robot b: far until the clock is above 2, the tie included.
    assert np.array(given).T.tolist() == [[1, 1, 1, 1], [1, 1, 1, 0]]


@pytest.mark.parametrize(
    "place", [("observatio", (0,)), ("observation", (3,)), ("observation", (0, 0))]
)
def test_a_wrong_place_of_nearness_is_named(place):
    class Wrong(NearEnv):
        goal_nearness = {"near": place}  # noqa: RUF012

    with pytest.raises(ValueError) as caught:
        make_team_vec_env(Wrong, 1)
    assert repr(place[0]) in one_line(caught.value)
    assert "'near'" in str(caught.value)


@pytest.fixture
def third_role():
    role = register_role(Role("rest", reward_component="explore", goal_set="frontier"))
    yield role
    del registry.ROLES[role.name]


def test_a_third_role_is_one_registry_entry_and_trains(third_role):
    env = small_search(
        roles={
            "roles": ("explore", "cover", "rest"),
            "primitive_weights": {"explore": {"explore": 1}, "cover": {"cover": 1}, "rest": {}},
        }
    )
    assert env.action_space == spaces.MultiDiscrete([3, 5])
    model = HMAPPO("RolePolicy", env, n_steps=10, batch_size=10, policy_kwargs=SMALL_ROLE, seed=0)
    model.learn(2 * 10 * env.num_envs)
    actions, _ = model.predict(env.reset())
    assert set(actions[:, 0]) <= {0, 1, 2}
    roles = [model.predict(env.reset())[0][:, 0] for _ in range(20)]
    assert set(np.concatenate(roles)) == {0, 1, 2}


def test_a_role_of_the_registry_is_not_replaced_silently(third_role):
    assert register_role(third_role) is third_role
    with pytest.raises(ValueError, match="registered already"):
        register_role(Role("rest", reward_component="cover"))
    assert get_roles(["rest", "cover"])[0] == third_role


BAD = [
    ({"roles": ("explore", "cove")}, "did you mean 'cover'"),
    ({"roles": ()}, "at least one"),
    ({"roles": ("cover", "cover")}, "each once"),
    ({"role_weights": {"explor": 1.0}}, "did you mean 'explore'"),
    ({"role_weights": {"explore": float("nan")}}, "finite"),
    ({"role_weights": {"explore": "1"}}, "must be a number"),
    ({"primitive_weights": "identiti"}, "did you mean 'identity'"),
    ({"primitive_weights": {"explore": {"explore": 1.0}}}, "'cover' is none"),
    ({"primitive_weights": {"explore": {}, "covr": {}}}, "did you mean 'cover'"),
    ({"primitive_weights": {"explore": {"cove": 1}, "cover": {}}}, "did you mean 'cover'"),
    ({"reward_sharing": "same_rol"}, "did you mean 'same_role'"),
    ({"role_every": 0}, "got 0"),
    ({"role_every": 2.0}, "got 2.0"),
    ({"role_every": True}, "got True"),
    ({"role_control": "lerned"}, "did you mean 'learned'"),
    ({"role_control": "explorer"}, "did you mean 'explore'"),
    ({"role_control": "neares"}, "did you mean 'nearest'"),
]


@pytest.mark.parametrize(("options", "hint"), BAD)
def test_bad_options_give_one_line_with_what_would_do(options, hint):
    with pytest.raises(ValueError) as caught:
        small_search(roles=options)
    assert hint in one_line(caught.value)


def test_roles_need_discrete_actions_of_teams():
    env = toy()
    with pytest.raises(ValueError, match="discrete"):
        RoleWrapper(env)
