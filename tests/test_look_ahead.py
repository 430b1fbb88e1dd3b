"""Joint look-ahead: routes on maps small enough to know them, and who walks them."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from helpers import DOWN, LEFT, RIGHT, STOP, UP, hand_made

from area_search import BatchedAreaSearch, Scene
from area_search.look_ahead_data import (
    CERTAIN,
    CHANCES,
    DEPTH,
    LEAST_ODDS,
    discount_at,
    n_orders,
    passable_odds,
    role_worths,
    unseen_worths,
)
from area_search.paths import ROLE_ROUTES
from sb3_roles.baselines import controller_class
from sb3_roles.evaluation.episodes import run_episodes

ROUTE = 2
SMALL = Scene(name="small", height=14, width=11, n_targets=20, n_agents=3, horizon=30)


def features(rows, robots=None):
    return hand_made(rows, robots, sub_goal="routes").observations["sub_goal"][0, :, ROUTE]


def check(got, moves, steps, worth=None):
    """Compare a robot's flags and nearness, and by first move the worth of its best route."""
    flags = np.zeros(5)
    flags[list(moves)] = 1
    assert got[:5].tolist() == flags.tolist()
    assert got[5] == pytest.approx(0.0 if steps is None else 0.9**steps, rel=1e-6)
    for move, expected in (worth or {}).items():
        assert got[6 + move] == pytest.approx(expected, rel=1e-4, abs=1e-5)


# Hand-made episodes have just begun.
DISCOUNT = discount_at(Scene().horizon)


def late(*steps):
    return sum(DISCOUNT**t for t in steps)


@pytest.mark.parametrize("steps", [1, 4, DEPTH - 1, DEPTH, DEPTH + 1, 40])
def test_a_target_at_the_end_of_a_corridor_however_far(steps):
    (got,) = features(["#" * (steps + 3), "#0" + "." * (steps - 1) + "T#"])
    check(got, [RIGHT], steps, {RIGHT: late(steps), LEFT: 0, UP: 0, DOWN: 0, STOP: 0})


def test_three_targets_together_are_worth_more_than_a_nearer_one():
    (got,) = features(["###########", "#T.0..TTT.#"])
    # Left first and then right falls behind right at once, and is not followed any farther.
    check(got, [RIGHT], 3, {LEFT: late(2), RIGHT: late(3, 4, 5, 12)})


def test_all_ways_that_are_as_good_are_flagged():
    (got,) = features(["#####", "#0..#", "#...#", "#..T#"])
    check(got, [RIGHT, DOWN], 4, {RIGHT: late(4), DOWN: late(4)})


def test_of_two_ways_the_one_with_a_target_on_it():
    (got,) = features(["#####", "#0..#", "#T..#", "#..T#"])
    check(got, [DOWN], 1, {DOWN: late(1, 4)})


def test_nothing_to_gain_is_all_zero():
    assert not features(["#######", "#0..#T#", "#######"]).any()
    assert not features(["#######", "#0.cc1#"]).any()


def test_team_mates_share_out_what_there_is():
    first, second = features(["##################", "#T..0........1..T#"])
    check(first, [LEFT], 3, {LEFT: late(3)})
    check(second, [RIGHT], 3, {RIGHT: late(3)})


def test_robots_in_one_cell_part():
    got = features(["#########", "#T..0..T#"], robots=[(1, 4), (1, 4)])
    assert {int(got[0, :5].argmax()), int(got[1, :5].argmax())} == {LEFT, RIGHT}


def test_who_comes_first_takes_it_and_the_other_goes_on():
    # Both would go for the target between them; robot 1 is nearer.
    first, second = features(["#############", "#0...T1....T#"])
    check(second, [LEFT], 1, {LEFT: late(1, 7) - late(4, 10)})
    # Robot 1 gets both sooner than robot 0, which is left with nothing and plans as if it were
    # alone.
    check(first, [RIGHT], 4, {RIGHT: late(4, 10)})


def test_a_robot_that_comes_sooner_gains_the_difference():
    # Robot 0 plans first and takes both targets; robot 1 reaches the far one 6 steps sooner. That
    # is no reason for robot 0 to plan again, which would have got it late.
    first, second = features(["############", "#0.T.....T.1", "############"])
    check(first, [RIGHT], 2, {RIGHT: late(2, 8)})
    check(second, [LEFT], 2, {LEFT: late(2) - late(8)})


def test_unseen_cells_are_worth_the_targets_to_be_expected():
    rows = ["########", "#0..####", "####?###", "########"]
    batch = hand_made(rows, sub_goal="routes")
    (got,) = batch.observations["sub_goal"][0, :, ROUTE]
    # The unseen cell has known obstacles on all four sides: it can hardly be free.
    density = batch.scene.n_targets / batch.scene.n_free
    assert CHANCES[4] == 0.0
    assert 0 < got[6 + RIGHT] < 0.01 * density


def test_a_route_goes_on_through_unseen_cells_as_far_as_its_way_may_be_open():
    open_place = ["?" * 20] * 3
    batch = hand_made([*open_place, "#0.." + "?" * 16, *open_place], sub_goal="routes")
    (got,) = batch.observations["sub_goal"][0, :, ROUTE]
    check(got, [RIGHT], 1)
    scene = batch.scene
    worth = unseen_worths(scene.n_targets / scene.n_free, 1, scene.horizon)[0]
    odds = passable_odds()[0] / CERTAIN
    n_unseen = int(np.log(LEAST_ODDS) / np.log(odds))
    assert 2 <= n_unseen <= DEPTH - 2
    # Straight on, first over two known cells. Of the cells that come into view with a step, one is
    # known with the first step, and none is later.
    new = [4] + [5] * (1 + n_unseen)
    chances = [1.0, 1.0] + [odds**k for k in range(1, n_unseen + 1)]
    gains = [worth * n * p * late(k + 1) for k, (n, p) in enumerate(zip(new, chances, strict=True))]
    # It is at least worth this, and more than what known cells alone would be.
    assert got[6 + RIGHT] > 0.98 * sum(gains)
    assert got[6 + RIGHT] > 1.5 * sum(gains[:2])


def test_a_target_behind_an_unseen_cell_counts_by_the_chance_of_the_way():
    odds = passable_odds() / CERTAIN
    assert odds[2] < LEAST_ODDS < odds[1] < odds[0] < 1
    known = features(["#######", "#0...T#"])[0]
    # The unseen cell on the way has an obstacle on one side; the other one, which comes into view,
    # is hardly worth anything.
    (got,) = features(["#######", "#0.?.T#", "###?###"])
    assert odds[1] * known[6 + RIGHT] <= got[6 + RIGHT] < (odds[1] + 0.01) * known[6 + RIGHT]
    # With obstacles on two sides it can hardly be free.
    assert not features(["#######", "#0.?.T#"]).any()


def test_what_is_expected_counts_more_where_robots_have_less_to_do():
    # The paper's training scene: 100 targets on 375 free cells for 4 robots.
    late, early = (unseen_worths(100 / 375, 4, left) for left in (50, 0))
    assert late == pytest.approx(np.array(CHANCES) * 100 / 375 * 1.1)
    assert early == pytest.approx(np.array(CHANCES) * 100 / 375 * 0.5)
    twice = unseen_worths(100 / 375, 8, 50)
    assert twice == pytest.approx(late * 2**0.6)
    assert unseen_worths(50 / 375, 4, 50) == pytest.approx(twice / 2)
    assert unseen_worths(100 / 375, 1000, 50).max() == 1.0


def test_large_teams_make_fewer_plans():
    assert [n_orders(n) for n in (1, 3, 4, 8, 9, 11, 16, 17, 50)] == [1, 3, 4, 4, 3, 2, 2, 1, 1]


@pytest.mark.parametrize(
    ("less", "more", "n_rows", "shared"),
    [("assigned", "routes", 3, slice(ROUTE)), ("routes", "role_routes", 5, slice(2, None))],
)
def test_further_routes_leave_the_other_rows_alone(less, more, n_rows, shared):
    batches = [BatchedAreaSearch(SMALL, 8, name) for name in (less, more)]
    rng = np.random.default_rng(0)
    for batch in batches:
        batch.reset(3)
    for _ in range(SMALL.horizon):
        fewer, rows = (batch.observations["sub_goal"] for batch in batches)
        assert rows.shape == (8, 3, n_rows, 11)
        assert np.array_equal(rows[:, :, shared], fewer)
        assert all(rows[:, :, k].any() for k in range(n_rows))
        actions = rng.integers(0, 5, (8, 3))
        for batch in batches:
            batch.step(actions)


def test_each_role_has_worths_that_the_search_can_bound():
    worths = role_worths()
    assert worths.shape == (len(ROLE_ROUTES), 2)
    assert 0 <= worths.min() <= worths.max() == CERTAIN


def test_a_robot_may_set_out_for_a_cell_that_it_has_not_seen_only_if_it_is_in_view():
    # In play a start is always explored around; a state that is set may be otherwise.
    rows = ["###.####", "##0?.T##", "###.####"]
    assert hand_made(rows, sub_goal="routes").observations["sub_goal"][0, 0, ROUTE, RIGHT] == 1


def test_in_each_role_a_robot_has_a_route_of_its_own():
    # Unseen cells on the left, a target on the right.
    batch = hand_made(["?????????", "??...0..T", "?????????"], sub_goal="role_routes")
    explore, cover, _, target, joint = batch.observations["sub_goal"][0, 0]
    assert explore[:5].argmax() == LEFT
    assert cover[:5].tolist() == target[:5].tolist() == [0, 0, 1, 0, 0]
    weights = role_worths() / CERTAIN
    assert cover[6 + RIGHT] >= weights[1, 0] * late(3) * 0.99
    # What the role counts less is worth less to it, and all to the joint plan.
    assert explore[6 + RIGHT] < joint[6 + RIGHT]
    assert cover[6 + LEFT] < joint[6 + LEFT]


def test_in_roles_too_robots_leave_what_team_mates_plan_for():
    rows = ["##################", "#T..0........1..T#"]
    got = hand_made(rows, sub_goal="role_routes").observations["sub_goal"][0]
    for role, part in enumerate(role_worths()[:, 0] / CERTAIN):
        check(got[0, role], [LEFT], 3, {LEFT: part * late(3)})
        check(got[1, role], [RIGHT], 3, {RIGHT: part * late(3)})


def test_routes_follow_from_the_state_alone():
    batch = BatchedAreaSearch(SMALL, 5, "routes")
    batch.reset(4)
    other = BatchedAreaSearch(SMALL, 5, "routes")
    rng = np.random.default_rng(1)
    for _ in range(12):
        batch.step(rng.integers(0, 5, (5, 3)))
        other.set_state(batch.get_state())
        expected = batch.observations["sub_goal"]
        assert np.array_equal(other.observations["sub_goal"], expected)


def test_few_routes_fall_short_of_the_best_walk():
    """In corridors, all walks of ``DEPTH`` steps can be tried."""
    rng = np.random.default_rng(2)
    walks = np.cumsum(np.array(list(product([-1, 1], repeat=DEPTH))), axis=1)
    before = np.pad(walks, ((0, 0), (1, 0)))[:, :-1]
    farthest = np.maximum.accumulate(before, axis=1), np.minimum.accumulate(before, axis=1)
    new = (walks > farthest[0]) | (walks < farthest[1])
    shares = []
    for _ in range(60):
        length = 2 * DEPTH + 1
        targets = rng.random(length) < 0.3
        targets[DEPTH] = False
        row = "".join("T" if target else "." for target in targets)
        row = row[:DEPTH] + "0" + row[DEPTH + 1 :]
        (got,) = features(["#" * (length + 2), f"#{row}#"])
        gains = new * targets[DEPTH + walks] * DISCOUNT ** np.arange(1.0, DEPTH + 1)
        best = gains.sum(axis=1).max()
        found = float(got[6:].max())
        assert found <= best * (1 + 1e-5)
        shares.append(found / best)
    assert np.mean(np.array(shares) > 0.999) > 0.9
    assert min(shares) > 0.9


def begin(batch):
    controller = controller_class("look_ahead")()
    controller.begin(batch)
    return controller


def test_the_controller_walks_its_routes():
    batch = hand_made(["###########", "#T.0..TTT.#"])
    controller = begin(batch)
    for _ in range(5):
        batch.step(controller.act(batch))
    assert batch.totals[0, 2] == 3
    assert batch.position[0, 0].tolist() == [1, 8]


def test_the_controller_takes_a_move_that_is_flagged():
    batch = BatchedAreaSearch(SMALL, 20, "routes")
    batch.reset(5)
    controller = begin(batch)
    for _ in range(SMALL.horizon):
        flags = batch.observations["sub_goal"][:, :, ROUTE, :5].copy()
        actions = controller.act(batch)
        taken = np.take_along_axis(flags, actions[..., None], axis=2)[..., 0]
        assert np.array_equal(taken == 1, flags.any(axis=2))
        assert (actions[~flags.any(axis=2)] == STOP).all()
        batch.step(actions)


def test_an_episode_is_the_same_in_any_batch():
    together = run_episodes(controller_class("look_ahead")(), SMALL, 9, seed=6)
    apart = run_episodes(controller_class("look_ahead")(), SMALL, 9, seed=6, batch_size=2)
    for name, counts in together.counts.items():
        assert np.array_equal(counts, apart.counts[name])


def test_it_beats_nearest_pairs():
    """By 13 and 7 points on ``hard``; the standard errors of the differences are below 0.7."""
    scores = {}
    for name in ("greedy_assigned", "look_ahead"):
        records = run_episodes(controller_class(name)(), "hard", 300, seed=7)
        scores[name] = [100 * records.curves[key][:, -1] for key in ("explo_paper", "cover")]
    gain = np.array(scores["look_ahead"]) - np.array(scores["greedy_assigned"])
    assert gain[0].mean() > 10
    assert gain[1].mean() > 5
