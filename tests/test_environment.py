"""What always holds while teams play, and that an episode depends on nothing but its number."""

from __future__ import annotations

import copy
import gc
import io
import pickle
import tracemalloc
from typing import Any

import numpy as np
import pytest
from helpers import (
    DOWN,
    LEFT,
    RIGHT,
    STOP,
    UP,
    boards,
    episode_actions,
    hand_made,
    has,
    lone_episode,
    one_line,
    play_episode,
    reachable,
    visible,
)

from area_search import SCENES, AreaSearchEnv, BatchedAreaSearch, Scene, get_scene
from area_search import cells as layout
from sb3_roles.prove.search_watch import Watch

SIZES = {
    "5x5": {"height": 5, "width": 5, "n_targets": 7},
    "7x31": {"height": 7, "width": 31, "n_targets": 40, "sensor_radius": 3.5},
    "60x40": {"height": 60, "width": 40, "n_targets": 300, "view_radius": 2},
    "200x200": {"height": 200, "width": 200, "n_targets": 4000},
    "no obstacles": {"free_fraction": 1.0, "sensor_radius": 0.0},
    "one free cell": {"free_fraction": 1e-9, "n_targets": 1},
    "a target in every free cell": {"n_targets": 375, "early_stop_patience": 2},
}
TASKS = {
    **{f"{name}, {n}": get_scene(name, n_agents=n) for name in SCENES for n in (1, 4, 8, 15, 50)},
    **{
        f"{name}, {n}": get_scene("hard", n_agents=n, **options)
        for name, options in SIZES.items()
        for n in (1, 8)
    },
}


@pytest.mark.parametrize("task", TASKS)
def test_invariants_of_random_play(task: str) -> None:
    scene = TASKS[task]
    large = scene.n_cells > 10_000
    batch = BatchedAreaSearch(scene, 2 if large else 3)
    batch.reset(len(task))
    rng = np.random.default_rng(len(task))
    free = ~has(boards(batch), layout.OBSTACLE)
    assert [reachable(one) for one in free] == [scene.n_free] * batch.n_teams
    watch = Watch(batch)
    assert watch.begin() == []
    ended = 0
    for _ in range(12 if large else scene.horizon + 10):
        assert watch.step(rng.integers(0, 5, (batch.n_teams, batch.n_agents))) == []
        done = batch.terminated | batch.truncated
        if done.any():
            batch.reset_teams(done)
            assert watch.begin(done) == []
            ended += int(done.sum())
    if not large:
        assert ended >= batch.n_teams


@pytest.mark.parametrize("sub_goal", ["nearest", "assigned", "routes", "role_routes"])
@pytest.mark.parametrize("size", ["5x5", "7x31", "200x200", "one free cell"])
def test_sub_goals_stay_inside_their_space(size: str, sub_goal: str) -> None:
    batch = BatchedAreaSearch(get_scene("hard", **SIZES[size]), 2, sub_goal)
    batch.reset(1)
    rng = np.random.default_rng(1)
    watch = Watch(batch)
    assert watch.begin() == []
    for _ in range(10):
        assert watch.step(rng.integers(0, 5, (2, 4))) == []
        assert np.isfinite(batch.observations["sub_goal"]).all()


def test_explo_paper_may_exceed_one_and_explo_true_never_does() -> None:
    batch = BatchedAreaSearch("obstacles_52", 20, n_agents=50, horizon=150)
    batch.reset(0)
    rng = np.random.default_rng(0)
    for _ in range(150):
        batch.step(rng.integers(0, 5, (20, 50)))
    assert (batch.metrics["explo_paper"] > 1).any()
    assert batch.metrics["explo_true"].max() <= 1


def test_a_batch_needs_a_reset_before_its_first_step() -> None:
    # Without one there is no border of obstacles, and robots would leave the arrays' memory.
    with pytest.raises((RuntimeError, ValueError), match="reset") as raised:
        BatchedAreaSearch("hard").step(np.zeros((1, 4), int))
    one_line(raised.value)


# Hand-made maps: what a step does.


def test_a_robot_that_stays_or_is_blocked_earns_nothing_and_moves_nowhere() -> None:
    for action in range(5):
        batch = hand_made(["?%#%?", "?#0#?", "?%#%?"])
        before = boards(batch)
        batch.step(np.array([[action]]))
        assert np.array_equal(boards(batch), before)
        assert batch.position.tolist() == [[[1, 2]]]
        assert batch.rewards.tolist() == [[0.0]]


@pytest.mark.parametrize(
    ("action", "corner"),
    [(UP, (0, 0)), (LEFT, (0, 0)), (RIGHT, (4, 5)), (DOWN, (4, 5)), (UP, (0, 5)), (LEFT, (4, 0))],
)
def test_the_edge_of_the_map_blocks(action: int, corner: tuple[int, int]) -> None:
    batch = hand_made(["......"] * 5, robots=[corner])
    batch.step(np.array([[action]]))
    assert tuple(batch.position[0, 0]) == corner


@pytest.mark.parametrize(
    ("action", "end"),
    [(STOP, (2, 2)), (UP, (1, 2)), (RIGHT, (2, 3)), (DOWN, (3, 2)), (LEFT, (2, 1))],
)
def test_moves_are_absolute(action: int, end: tuple[int, int]) -> None:
    batch = hand_made([".....", ".....", "..0..", ".....", "....."])
    batch.step(np.array([[action]]))
    assert tuple(batch.position[0, 0]) == end


def test_robots_may_share_a_cell_and_leave_it_one_by_one() -> None:
    batch = hand_made(["#####", "#0.1#"])
    batch.step(np.array([[RIGHT, LEFT]]))
    assert batch.position[0].tolist() == [[1, 2], [1, 2]]
    assert batch.observations["state"][0, 3].sum() == 1
    batch.step(np.array([[LEFT, STOP]]))
    assert batch.position[0].tolist() == [[1, 1], [1, 2]]
    assert np.argwhere(batch.observations["state"][0, 3]).tolist() == [[1, 1], [1, 2]]
    # Passing through each other is no collision either.
    batch.step(np.array([[RIGHT, LEFT]]))
    assert batch.position[0].tolist() == [[1, 2], [1, 1]]


@pytest.mark.parametrize("robots", [[(1, 1), (1, 3)], [(1, 3), (1, 1)]])
def test_a_target_reached_together_counts_for_the_lower_index(
    robots: list[tuple[int, int]],
) -> None:
    batch = hand_made(["#####", "#.T.#"], robots=robots)
    towards = [RIGHT if column == 1 else LEFT for _, column in robots]
    batch.step(np.array([towards]))
    assert batch.new_targets.tolist() == [[1, 0]]
    assert batch.reward_components[0, :, 1].tolist() == [1, 0]
    assert batch.metrics["cover"][0] == 1


@pytest.mark.parametrize("robots", [[(2, 0), (2, 2)], [(2, 2), (2, 0)]])
def test_cells_seen_together_count_for_the_lower_index(robots: list[tuple[int, int]]) -> None:
    # Both robots step into the middle of the upper row's sight; the disc of radius 1 is a plus.
    rows = ["?????", "?????", "...??", "?????", "?????"]
    batch = hand_made(rows, robots=robots, sensor_radius=1.0)
    towards = [RIGHT if column == 0 else LEFT for _, column in robots]
    batch.step(np.array([towards]))
    assert batch.position[0].tolist() == [[2, 1], [2, 1]]
    assert batch.new_cells.tolist() == [[2, 0]]


def test_partly_overlapping_discs_share_out_in_index_order() -> None:
    # Moving down, each plus brings (down) and (left, right) into view; they overlap in one cell.
    rows = [".....", "?????", "?????", "?????", "?????"]
    for robots in ([(0, 1), (0, 3)], [(0, 3), (0, 1)]):
        batch = hand_made(rows, robots=robots, sensor_radius=1.0)
        # The cells under the robots are in view already in a real episode.
        batch.step(np.array([[DOWN, DOWN]]))
        assert batch.new_cells.tolist() == [[3, 2]]
        assert batch.metric_values[0, 0] * batch.scene.n_free == 5


def test_a_blocked_robot_is_not_moved_by_a_later_one() -> None:
    batch = hand_made(["######", "#01..#"])
    batch.step(np.array([[LEFT, RIGHT]]))
    assert batch.position[0].tolist() == [[1, 1], [1, 3]]


@pytest.mark.parametrize("scene", SCENES)
def test_start_discs_are_explored_and_start_cells_covered_without_score(scene: str) -> None:
    batch = BatchedAreaSearch(scene, 40)
    batch.reset(9)
    board = boards(batch)
    rows, columns = np.mgrid[0:25, 0:25]
    near = np.zeros(board.shape, bool)
    under = np.zeros(board.shape, bool)
    for m, robots in enumerate(batch.position):
        for y, x in robots:
            near[m] |= (rows - y) ** 2 + (columns - x) ** 2 <= 4
            under[m, y, x] = True
    assert np.array_equal(has(board, layout.EXPLORED), near)
    covered = has(board, layout.COVERED)
    assert covered.any()
    assert not (covered & ~under).any()
    assert not has(board, layout.TARGET)[under].any()
    for array in (batch.rewards, batch.reward_components, batch.new_cells, batch.new_targets):
        assert not array.any()
    batch.step(np.zeros((40, 4), int))
    assert not batch.metrics["explo_paper"].any()
    assert not batch.metrics["cover"].any()
    assert (batch.metrics["explo_true"] > 0).all()


# Rewards.


@pytest.mark.parametrize(("alpha", "beta"), [(0.4, 0.6), (0.1, 0.9), (0, 1), (1, 0), (3, 2.5)])
@pytest.mark.parametrize("normalizer", [3.0, 5.0, 16.52])
def test_the_reward_is_the_weighted_sum(alpha: float, beta: float, normalizer: float) -> None:
    batch = BatchedAreaSearch(
        "easy", 30, alpha=alpha, beta=beta, explore_normalizer=normalizer, n_agents=6
    )
    batch.reset(4)
    rng = np.random.default_rng(4)
    seen_both = False
    for _ in range(20):
        batch.step(rng.integers(0, 5, (30, 6)))
        explore, cover = batch.new_cells / normalizer, batch.new_targets
        assert batch.reward_components[..., 0] == pytest.approx(explore, rel=1e-6)
        assert np.array_equal(batch.reward_components[..., 1], cover)
        assert batch.rewards == pytest.approx(alpha * explore + beta * cover, rel=1e-6)
        seen_both |= bool(((explore > 0) & (cover > 0)).any())
    assert seen_both


def test_same_role_sharing_sums_over_the_robots_of_a_role() -> None:
    shared = BatchedAreaSearch("easy", 20, n_agents=6, reward_sharing="same_role")
    own = BatchedAreaSearch("easy", 20, n_agents=6)
    shared.reset(4)
    own.reset(4)
    rng = np.random.default_rng(4)
    for step in range(20):
        roles = rng.integers(0, 3, (20, 6))
        if step == 0:
            roles[:] = 0  # as when no roles were ever told: the whole team
        else:
            shared.set_roles(roles)
        actions = rng.integers(0, 5, (20, 6))
        shared.step(actions)
        own.step(actions)
        same = roles[:, :, None] == roles[:, None, :]
        explore = np.einsum("mij,mj->mi", same, own.new_cells) / 3
        cover = np.einsum("mij,mj->mi", same, own.new_targets)
        assert shared.reward_components[..., 0] == pytest.approx(explore, rel=1e-6)
        assert np.array_equal(shared.reward_components[..., 1], cover)
        assert shared.rewards == pytest.approx(0.4 * explore + 0.6 * cover, rel=1e-6)
        assert np.array_equal(shared.metric_values, own.metric_values)


@pytest.mark.parametrize(
    "roles",
    [
        np.zeros((2, 3), int),
        np.zeros(4, int),
        np.zeros((1, 4)),
        np.full((1, 4), -1),
        np.full((1, 4), 16),
        [["a"] * 4],
    ],
)
def test_wrong_roles_are_refused_and_change_nothing(roles: Any) -> None:
    batch = BatchedAreaSearch("hard")
    batch.reset(0)
    batch.set_roles([[1, 0, 1, 2]])
    with pytest.raises(ValueError, match="roles") as raised:
        batch.set_roles(roles)
    one_line(raised.value)
    assert batch.roles.tolist() == [[1, 0, 1, 2]]


# How an episode ends, and what is measured.


def test_the_horizon_truncates_all_robots_together() -> None:
    env = AreaSearchEnv("hard", horizon=7)
    env.reset(seed=0)
    for step in range(1, 8):
        agents = env.agents
        _, _, terminations, truncations, _ = env.step(dict.fromkeys(agents, STOP))
        assert terminations == dict.fromkeys(agents, False)
        assert truncations == dict.fromkeys(agents, step == 7)
    assert env.agents == []


@pytest.mark.parametrize("patience", [1, 3, 10])
def test_early_stop_ends_the_episode_for_all_when_one_robot_finds_nothing(patience: int) -> None:
    env = AreaSearchEnv("hard", early_stop_patience=patience)
    env.reset(seed=0)
    for step in range(1, patience + 1):
        agents = env.agents
        _, _, terminations, truncations, _ = env.step(dict.fromkeys(agents, STOP))
        assert terminations == dict.fromkeys(agents, step == patience)
        assert not any(truncations.values())
    assert env.agents == []


def test_a_new_target_resets_the_patience_of_its_finder_only() -> None:
    batch = hand_made(["########", "#0T....#", "########", "#1TTTTT#"], early_stop_patience=3)
    for step, done in enumerate([False, False, False, True]):
        # Robot 0 finds one in the first step and none afterwards; robot 1 finds one in each.
        batch.step(np.array([[RIGHT, RIGHT]]))
        assert batch.new_targets.tolist() == [[int(step == 0), 1]]
        assert batch.terminated.tolist() == [done]
    assert not batch.truncated.any()


def test_without_patience_nothing_terminates() -> None:
    batch = BatchedAreaSearch("hard", 3, horizon=40)
    batch.reset(0)
    for step in range(1, 41):
        batch.step(np.zeros((3, 4), int))
        assert not batch.terminated.any()
        assert batch.truncated.tolist() == [step == 40] * 3


def test_first_steps_with_90_percent_by_hand() -> None:
    # Ten free cells in a corridor; a step shows the next of them and the two walls beside it.
    rows = ["##%%%%%%%%%%", "#0.????????#", "##%%%%%%%%%%"]
    batch = hand_made(rows, sensor_radius=1.0)
    assert batch.scene.n_free == 10
    paper, true = [], []
    for _ in range(9):
        batch.step(np.array([[RIGHT]]))
        paper.append(batch.metrics["explo_paper"][0])
        true.append(batch.metrics["explo_true"][0])
    assert paper == [n / 10 for n in (3, 6, 9, 12, 15, 18, 21, 24, 26)]
    assert true == [n / 10 for n in (3, 4, 5, 6, 7, 8, 9, 10, 10)]
    metrics = batch.episode_metrics(0)
    # More than 0.9 (0.9 itself, in step 2, is not enough), and at least 0.9 (in step 6 it is).
    assert metrics["t90_paper"] == 3
    assert metrics["t90_true"] == 6
    assert metrics["length"] == 9


def test_first_steps_with_90_percent_of_random_play() -> None:
    batch = BatchedAreaSearch("hard", 60, height=7, width=7, n_targets=5, sensor_radius=2.0)
    batch.reset(3)
    rng = np.random.default_rng(3)
    curves = []
    for _ in range(50):
        batch.step(rng.integers(0, 5, (60, 4)))
        curves.append(batch.metric_values.copy())
    paper, true, _ = np.moveaxis(np.array(curves), 2, 0)
    for reached, name in ((paper > 0.9, "t90_paper"), (true >= 0.9, "t90_true")):
        first = np.where(reached.any(axis=0), reached.argmax(axis=0), -1)
        assert first.tolist() == [batch.episode_metrics(m)[name] for m in range(60)]
        assert -1 in first
        assert first.max() > 0


def test_the_explored_share_counts_the_start_discs_from_the_beginning() -> None:
    batch = BatchedAreaSearch("hard", 2)
    batch.reset(0)
    board = boards(batch)
    known = has(board, layout.EXPLORED) & ~has(board, layout.OBSTACLE)
    for team in range(2):
        assert batch.episode_metrics(team)["explo_true"] == known[team].sum() / batch.scene.n_free


# An episode is a function of (scene, seed, episode).

TASK = get_scene(
    "medium", n_agents=3, early_stop_patience=10, reward_sharing="same_role", horizon=30
)
SUB_GOALS = ["none", "nearest", "assigned", "routes", "role_routes"]


@pytest.mark.parametrize("sub_goal", SUB_GOALS)
def test_an_episode_is_the_same_alone_and_among_64(sub_goal: str) -> None:
    batch = BatchedAreaSearch(TASK, 64, sub_goal)
    batch.reset(5)
    plans = np.stack([episode_actions(TASK, 5, m) for m in range(64)], axis=1)
    recorded = {m: [visible(batch, m, reset=True)] for m in (0, 1, 17, 63)}
    for step in range(TASK.horizon):
        batch.step(plans[step])
        for m, record in recorded.items():
            record.append(visible(batch, m))
    for m, record in recorded.items():
        np.testing.assert_equal(record, lone_episode(TASK, 5, m, sub_goal))


def test_an_episode_is_the_same_alone_and_among_4096() -> None:
    scene = get_scene("hard", horizon=6)
    batch = BatchedAreaSearch(scene, 4096)
    batch.reset(8)
    plans = np.random.default_rng(0).integers(0, 5, (6, 4096, 4))
    chosen = (0, 1, 2048, 4095)
    for step in range(6):
        batch.step(plans[step])
    for m in chosen:
        alone = BatchedAreaSearch(scene)
        alone.reset([8], m)
        for step in range(6):
            alone.step(plans[step, m : m + 1])
        np.testing.assert_equal(visible(alone, 0), visible(batch, m))
        assert np.array_equal(alone.cells[0], batch.cells[m])


def test_seeds_and_episodes_may_be_given_team_by_team() -> None:
    seeds, episodes = [11, 3, 11, 2**70], [4, 0, 5, 9]
    batch = BatchedAreaSearch(TASK, 4)
    for given in (seeds, tuple(seeds)):
        batch.reset(given, episodes)
        for m, (seed, episode) in enumerate(zip(seeds, episodes, strict=True)):
            expected = lone_episode(TASK, seed, episode)[0]
            np.testing.assert_equal(visible(batch, m, reset=True), expected)
    batch.reset(seeds)
    for m, seed in enumerate(seeds):
        np.testing.assert_equal(visible(batch, m, reset=True), lone_episode(TASK, seed, 0)[0])


@pytest.mark.parametrize("sub_goal", SUB_GOALS)
@pytest.mark.parametrize("episode", [0, 1, 7])
def test_the_pettingzoo_face_plays_the_same_episode(sub_goal: str, episode: int) -> None:
    env = AreaSearchEnv(TASK, sub_goal)
    observations, _ = env.reset(seed=6, options={"episode": episode})
    expected = lone_episode(TASK, 6, episode, sub_goal)
    plan = episode_actions(TASK, 6, episode)
    for step in range(TASK.horizon + 1):
        for i, agent in enumerate(env.possible_agents):
            for key, value in observations[agent].items():
                mine = expected[step][key]
                mine = mine if key in env.team_observation_keys else mine[i]
                assert np.array_equal(value, mine)
                assert value.dtype == mine.dtype
        if not env.agents:
            break
        observations, rewards, *_, infos = env.step(dict(zip(env.agents, plan[step], strict=True)))
        assert list(rewards.values()) == expected[step + 1]["rewards"].tolist()
    final = infos["robot_0"]["episode_metrics"]
    assert final == {name: expected[step][name] for name in final}


@pytest.mark.parametrize("first", [0, 5])
def test_resets_of_one_env_play_the_next_episodes(first: int) -> None:
    env = AreaSearchEnv(TASK)
    env.reset(seed=6, options={"episode": first})
    for episode in (first, first + 1, first + 2):
        expected = lone_episode(TASK, 6, episode)[0]
        assert np.array_equal(env.state(), expected["state"])
        env.reset()


@pytest.mark.parametrize("n_teams", [1, 3, 5])
def test_a_shared_seed_deals_its_episodes_to_the_teams_in_turn(n_teams: int) -> None:
    batch = BatchedAreaSearch(TASK, n_teams)
    batch.reset(2)
    for turn in range(3):
        for m in range(n_teams):
            expected = lone_episode(TASK, 2, m + turn * n_teams)[0]
            np.testing.assert_equal(visible(batch, m, reset=True), expected)
        batch.step(np.ones((n_teams, 3), int))
        batch.reset_teams(np.ones(n_teams, bool))


@pytest.mark.parametrize("n_teams", [1, 4])
def test_seeds_of_their_own_give_each_team_all_episodes(n_teams: int) -> None:
    batch = BatchedAreaSearch(TASK, n_teams)
    batch.reset(list(range(n_teams)))
    for turn in range(3):
        for m in range(n_teams):
            expected = lone_episode(TASK, m, turn)[0]
            np.testing.assert_equal(visible(batch, m, reset=True), expected)
        batch.reset_teams(np.ones(n_teams, bool))


def test_teams_that_end_at_different_times_still_play_their_own_episodes() -> None:
    batch = BatchedAreaSearch(TASK, 6)
    batch.reset(2)
    episodes = np.arange(6)
    rng = np.random.default_rng(0)
    uneven = False
    for _ in range(80):
        batch.step(rng.integers(0, 5, (6, 3)))
        done = batch.terminated | batch.truncated
        uneven |= bool(done.any() and not done.all())
        batch.reset_teams(done)
        episodes[done] += 6
        for m in np.flatnonzero(done):
            expected = lone_episode(TASK, 2, int(episodes[m]))[0]
            np.testing.assert_equal(visible(batch, m, reset=True), expected)
    assert uneven
    assert episodes.min() >= 12


def test_an_abandoned_episode_leaves_no_trace() -> None:
    batch = BatchedAreaSearch(TASK, 2, "assigned")
    fresh = lone_episode(TASK, 9, 1, "assigned")
    for seed in (1, 2):
        batch.reset(seed)
        for moves in episode_actions(TASK, seed, 0)[:13]:
            batch.set_roles(np.ones((2, 3), int))
            batch.step(np.stack([moves, moves]))
        batch.reset(9)
        np.testing.assert_equal(list(play_episode(batch, 1, episode_actions(TASK, 9, 1))), fresh)


def test_roles_of_an_episode_do_not_change_the_next_one() -> None:
    """Roles are told anew in each episode of the PettingZoo face, however it is reset."""
    rewards = []
    for options in (None, {"episode": 1}):
        env = AreaSearchEnv(TASK)
        env.reset(seed=6)
        env.set_roles([0, 1, 1])
        env.reset(seed=None if options is None else 6, options=options)
        plan = episode_actions(TASK, 6, 1)
        rewards.append(
            [env.step(dict(zip(env.agents, moves, strict=True)))[1] for moves in plan[:8]]
        )
    assert rewards[0] == rewards[1]


def test_different_seeds_and_episodes_give_different_episodes() -> None:
    seeds, episodes = np.divmod(np.arange(400), 20)
    batch = BatchedAreaSearch("hard", 400)
    batch.reset(seeds.tolist(), episodes.tolist())
    board = boards(batch)
    for bit in (layout.OBSTACLE, layout.TARGET):
        assert len({one.tobytes() for one in has(board, bit)}) == 400
    assert len({one.tobytes() for one in batch.position}) > 300


@pytest.mark.parametrize("n_agents", [1, 2, 15, 50])
def test_the_number_of_robots_does_not_change_the_map(n_agents: int) -> None:
    batches = [BatchedAreaSearch("hard", 20, n_agents=n) for n in (4, n_agents)]
    for batch in batches:
        batch.reset(1)
    for bits in (layout.OBSTACLE, layout.TARGET | layout.COVERED):
        few, many = (has(boards(batch), bits) for batch in batches)
        assert np.array_equal(few, many)
    shared = min(4, n_agents)
    assert np.array_equal(batches[0].position[:, :shared], batches[1].position[:, :shared])


@pytest.mark.parametrize(
    ("seed", "episode"),
    [
        (-1, None),
        ([0, -1], None),
        ([0], None),
        ([0, 1, 2], None),
        ([0.5, 1], None),
        (["a", 1], None),
        ([True, 1], None),
        (0, -1),
        (0, [0, -1]),
        (0, [0, 1, 2]),
        (0, 0.5),
        (0, "first"),
        (0, [[0, 1]]),
    ],
)
def test_wrong_seeds_and_episodes_are_refused_and_change_nothing(seed: Any, episode: Any) -> None:
    batch = BatchedAreaSearch("hard", 2)
    batch.reset(3)
    batch.step(np.ones((2, 4), int))
    before = batch.get_state()
    with pytest.raises(ValueError, match=r"seed|episode") as raised:
        batch.reset(seed, episode)
    one_line(raised.value)
    np.testing.assert_equal(batch.get_state(), before)


@pytest.mark.parametrize(
    "actions",
    [
        np.zeros((2, 3), int),
        np.zeros(8, int),
        np.zeros((2, 4)),
        np.zeros((2, 4), bool),
        np.full((2, 4), 5),
        np.full((2, 4), -1),
        [["up"] * 4] * 2,
        None,
    ],
)
def test_wrong_actions_are_refused_and_change_nothing(actions: Any) -> None:
    batch = BatchedAreaSearch("hard", 2)
    batch.reset(3)
    before = batch.get_state()
    with pytest.raises(ValueError, match="actions") as raised:
        batch.step(actions)
    one_line(raised.value)
    np.testing.assert_equal(batch.get_state(), before)


PLAN = np.random.default_rng(0).integers(0, 5, (5, 2, 4))


def after_the_plan() -> dict[str, np.ndarray]:
    """Return the state after ordinary actions."""
    batch = BatchedAreaSearch("hard", 2)
    batch.reset(3)
    for moves in PLAN:
        batch.step(moves)
    return batch.get_state()


@pytest.mark.parametrize("dtype", [np.int8, np.uint8, np.int32, np.int64, np.uint64])
def test_every_integer_type_of_actions_works(dtype: type) -> None:
    batch = BatchedAreaSearch("hard", 2)
    batch.reset(3)
    for moves in PLAN:
        batch.step(moves.astype(dtype))
    np.testing.assert_equal(batch.get_state(), after_the_plan())


def read_only(array: np.ndarray) -> np.ndarray:
    """Return a copy that cannot be written."""
    array = array.copy()
    array.flags.writeable = False
    return array


LAYOUTS = {
    "list": np.ndarray.tolist,
    "Fortran order": np.asfortranarray,
    "every other row": lambda moves: np.repeat(moves, 2, axis=0)[::2],
    "broadcast view": lambda moves: np.broadcast_to(moves, moves.shape),
    "read-only": read_only,
}


@pytest.mark.parametrize("memory", LAYOUTS)
def test_actions_and_choices_of_teams_work_in_every_memory_layout(memory: str) -> None:
    batch = BatchedAreaSearch("hard", 2)
    batch.reset(3)
    for moves in PLAN:
        batch.step(LAYOUTS[memory](moves))
    np.testing.assert_equal(batch.get_state(), after_the_plan())
    batch.reset_teams(LAYOUTS[memory](np.array([True, False])))
    assert batch.steps.tolist() == [0, len(PLAN)]


@pytest.mark.parametrize("which", [np.ones(3, bool), np.ones(2, int), [1, 0], True])
def test_wrong_choices_of_teams_are_refused_and_change_nothing(which: Any) -> None:
    batch = BatchedAreaSearch("hard", 2)
    batch.reset(3)
    before = batch.get_state()
    with pytest.raises(ValueError, match="which") as raised:
        batch.reset_teams(which)
    one_line(raised.value)
    np.testing.assert_equal(batch.get_state(), before)


# Saving and continuing.


def through_a_file(state: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Save a state as numpy does, and load it without pickling."""
    file = io.BytesIO()
    np.savez(file, **state)
    file.seek(0)
    with np.load(file, allow_pickle=False) as loaded:
        return {name: loaded[name] for name in loaded.files}


def fresh_from(batch: BatchedAreaSearch, how: str) -> BatchedAreaSearch:
    """Copy a batch in one of several ways."""
    if how == "deepcopy":
        return copy.deepcopy(batch)
    if how == "pickle":
        return pickle.loads(pickle.dumps(batch))
    other = BatchedAreaSearch(batch.scene, batch.n_teams, batch.sub_goal)
    if how == "after other play":
        other.reset(1234)
        other.step(np.full((batch.n_teams, batch.n_agents), DOWN))
    state = batch.get_state()
    other.set_state(through_a_file(state) if how == "file" else state)
    return other


def run_on(batch: BatchedAreaSearch, n_steps: int, seed: int) -> list[list[dict[str, Any]]]:
    """Play on with random actions, roles and autoresets; record everything."""
    rng = np.random.default_rng(seed)
    record = []
    for _ in range(n_steps):
        if rng.random() < 0.3:
            batch.set_roles(rng.integers(0, 2, (batch.n_teams, batch.n_agents)))
        batch.step(rng.integers(0, 5, (batch.n_teams, batch.n_agents)))
        record.append([visible(batch, m) for m in range(batch.n_teams)])
        done = batch.terminated | batch.truncated
        if done.any():
            batch.reset_teams(done)
            record.append([visible(batch, m, reset=True) for m in range(batch.n_teams)])
    return record


@pytest.mark.parametrize("sub_goal", SUB_GOALS)
@pytest.mark.parametrize("how", ["state", "file", "after other play", "deepcopy", "pickle"])
def test_a_copy_continues_bit_for_bit(sub_goal: str, how: str) -> None:
    batch = BatchedAreaSearch(TASK, 4, sub_goal)
    batch.reset(21)
    run_on(batch, 23, seed=0)
    other = fresh_from(batch, how)
    now = [[visible(one, m) for m in range(4)] for one in (batch, other)]
    np.testing.assert_equal(*now)
    straight = run_on(batch, 70, seed=1)
    assert len(straight) > 75  # several autoresets among them
    np.testing.assert_equal(run_on(other, 70, seed=1), straight)
    np.testing.assert_equal(other.get_state(), batch.get_state())


def test_a_state_is_a_copy() -> None:
    batch = BatchedAreaSearch(TASK, 2)
    batch.reset(0)
    state = batch.get_state()
    before = copy.deepcopy(state)
    run_on(batch, 5, seed=0)
    np.testing.assert_equal(state, before)
    batch.set_state(state)
    state["cells"][:] = 0
    np.testing.assert_equal(batch.get_state(), before)


@pytest.mark.parametrize("name", BatchedAreaSearch("hard").get_state())
@pytest.mark.parametrize("fault", ["missing", "shape", "dtype", "teams"])
def test_a_state_that_does_not_fit_is_refused_and_changes_nothing(name: str, fault: str) -> None:
    batch = BatchedAreaSearch(TASK, 2)
    batch.reset(0)
    other = BatchedAreaSearch(TASK, 2)
    other.reset(1)
    run_on(other, 3, seed=0)
    state: dict[str, Any] = other.get_state()
    if fault == "missing":
        del state[name]
    elif fault == "shape":
        state[name] = state[name][..., None]
    elif fault == "dtype":
        state[name] = state[name].astype(np.complex64)
    else:
        state[name] = state[name][:1]
    before, seen = batch.get_state(), [visible(batch, m) for m in range(2)]
    with pytest.raises(ValueError, match=name) as raised:
        batch.set_state(state)
    one_line(raised.value)
    np.testing.assert_equal(batch.get_state(), before)
    np.testing.assert_equal([visible(batch, m) for m in range(2)], seen)


def test_an_unknown_array_in_a_state_is_refused() -> None:
    batch = BatchedAreaSearch(TASK)
    batch.reset(0)
    with pytest.raises(ValueError, match="more") as raised:
        batch.set_state(batch.get_state() | {"more": np.zeros(1)})
    one_line(raised.value)


@pytest.mark.parametrize("options", [{"n_agents": 4}, {"height": 20}, {"view_radius": 6}], ids=str)
def test_the_state_of_another_scene_is_refused(options: dict[str, int]) -> None:
    other = BatchedAreaSearch(TASK.with_options(**options))
    other.reset(0)
    with pytest.raises(ValueError, match="state does not fit"):
        BatchedAreaSearch(TASK).set_state(other.get_state())


def test_scenes_are_not_changed_by_playing() -> None:
    before = {name: Scene(**vars(scene)) for name, scene in SCENES.items()}
    for name in SCENES:
        batch = BatchedAreaSearch(name)
        batch.reset(0)
        batch.step(np.ones((1, 4), int))
        assert batch.scene is SCENES[name]
    assert before == SCENES


@pytest.mark.parametrize("sub_goal", ["none", "nearest", "assigned", "routes", "role_routes"])
def test_steps_allocate_nothing(sub_goal: str) -> None:
    """Arrays stay where they are, and the traced memory does not depend on the maps' size."""
    batch = BatchedAreaSearch("hard", 64, sub_goal)
    batch.reset(0)
    actions = np.random.default_rng(0).integers(0, 5, (20, 64, batch.n_agents))
    before = {key: array.ctypes.data for key, array in batch.observations.items()}
    for moves in actions:
        batch.step(moves)
    peaks = []
    for _ in range(5):
        tracemalloc.start()
        try:
            for moves in actions:
                batch.step(moves)
                # Python keeps the tuples of arguments for later, until a collection.
                gc.collect()
            peaks.append(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()
    # A single map of one team has 625 cells; the batch has 64 teams and four kinds of maps. Numba
    # makes objects of the named tuples that the routes' kernel takes: 16 KB, whatever the maps.
    # Other threads, those of the test runner, allocate at times; what steps need is there always.
    assert min(peaks) < (64 if "routes" in sub_goal else 8) * 625
    assert {key: array.ctypes.data for key, array in batch.observations.items()} == before
