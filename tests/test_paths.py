"""Sub-goal features on maps small enough to know the answer by hand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from helpers import DOWN, LEFT, RIGHT, STOP, UP, hand_made

from area_search.paths import GOAL_SETS

FRONTIER, TARGET = 0, 1
MODES = ["nearest", "assigned"]


def goal_features(moves: Sequence[int], distance: int | None) -> np.ndarray:
    """First-move flags and nearness of a goal; no distance: no goal."""
    expected = np.zeros(6, np.float32)
    expected[list(moves)] = 1
    expected[5] = 0 if distance is None else 0.9**distance
    return expected


def check_goal(got: np.ndarray, moves: Sequence[int], distance: int | None) -> None:
    """Compare the features of one robot and goal set."""
    assert np.array_equal(got[:5], goal_features(moves, distance)[:5])
    # Sums are kept in fixed point with 32 bits behind the point, and handed out as float32.
    assert got[5] == pytest.approx(goal_features(moves, distance)[5], rel=2e-7, abs=2.0**-32)


def check_territory(got: np.ndarray, by_move: Mapping[int, Sequence[int]]) -> None:
    """Compare a robot's territory: per first move, the distances of the goals that are its own."""
    expected = np.zeros(5)
    for move, distances in by_move.items():
        expected[move] = sum(0.9**d for d in distances)
    assert got[6:] == pytest.approx(expected, rel=1e-6, abs=1e-9)


FIRST_MOVES = {
    # name: (map, frontier moves, frontier distance, target moves, target distance)
    "frontier to the right": (["#######", "#0...?#"], [RIGHT], 3, [], None),
    "frontier to the left": (["#######", "#?..0##"], [LEFT], 2, [], None),
    "frontier above": (["##?##", "##.##", "##.##", "##.##", "##0##", "#####"], [UP], 3, [], None),
    "frontier below": (["#####", "##0##", "##.##", "##.##", "##?##"], [DOWN], 2, [], None),
    "an unseen obstacle makes a frontier too": (["#######", "#0...%#"], [RIGHT], 3, [], None),
    "an unseen cell across a corner": (["#####", "#0..#", "####?"], [RIGHT], 2, [], None),
    "standing on the frontier": (["#####", "##0?#"], [STOP], 0, [], None),
    "on the frontier, with more beside": (["#?????#", "#..0..#", "#######"], [STOP], 0, [], None),
    "the nearer of two frontiers": (["########", "?..0...?"], [LEFT], 2, [], None),
    "target to the right": (["#######", "#0.T###"], [], None, [RIGHT], 2),
    "two shortest paths to one target": (
        ["#####", "#0..#", "#...#", "#..T#", "#####"],
        [],
        None,
        [RIGHT, DOWN],
        4,
    ),
    "only one of two ways is short": (
        ["#####", "#0#T#", "#.#.#", "#...#", "#####"],
        [],
        None,
        [DOWN],
        6,
    ),
    "a detour around a wall, with two arms": (
        ["#######", "#.....#", "#.###.#", "#0###T#", "#.###.#", "#.....#", "#######"],
        [],
        None,
        [UP, DOWN],
        8,
    ),
    "both goal sets, in opposite directions": (
        ["########", "#T..0.?#"],
        [RIGHT],
        1,
        [LEFT],
        3,
    ),
    "a target that is a frontier cell": (["######", "#0.T?#"], [RIGHT], 2, [RIGHT], 2),
    "nothing left to do": (["#####", "#0..#", "#####"], [], None, [], None),
    "covered targets are no goals": (["#####", "#0cc#", "#####"], [], None, [], None),
    "unseen targets are no goals": (["#####", "#0.t#", "#####"], [RIGHT], 1, [], None),
    "a known target behind a wall": (["######", "#0.#T#", "######"], [], None, [], None),
    "a known target behind unseen ground": (
        ["########", "#0.?..T#"],
        [RIGHT],
        1,
        [],
        None,
    ),
    "a frontier behind a wall": (["#######", "#0.#.?#"], [], None, [], None),
    "walled in": (["#####", "##0##", "#####", "#T..?"], [], None, [], None),
    "along the edge of the map": (
        ["0....", "####.", "####.", "####.", "T...."],
        [],
        None,
        [RIGHT],
        12,
    ),
}


@pytest.mark.parametrize("sub_goal", MODES)
@pytest.mark.parametrize("case", FIRST_MOVES)
def test_first_moves_and_nearness(case: str, sub_goal: str) -> None:
    rows, frontier_moves, frontier_distance, target_moves, target_distance = FIRST_MOVES[case]
    batch = hand_made(rows, sub_goal=sub_goal)
    got = batch.observations["sub_goal"][0, 0]
    check_goal(got[FRONTIER], frontier_moves, frontier_distance)
    check_goal(got[TARGET], target_moves, target_distance)


TIES = {
    # name: (map, goal set, moves of "nearest", move of "assigned": the goal first in the map)
    "frontiers left and right": (["#######", "?..0..?"], FRONTIER, [RIGHT, LEFT], LEFT),
    "frontiers above and below": (["#?#", "#.#", "#0#", "#.#", "#?#"], FRONTIER, [UP, DOWN], UP),
    "targets left and right": (["#######", "T..0..T"], TARGET, [RIGHT, LEFT], LEFT),
    "targets on all four sides": (
        ["##T##", "##.##", "T.0.T", "##.##", "##T##"],
        TARGET,
        [UP, RIGHT, DOWN, LEFT],
        UP,
    ),
}


@pytest.mark.parametrize("case", TIES)
def test_ties_give_all_moves_and_a_matching_takes_the_first_cell(case: str) -> None:
    rows, goal_set, all_moves, chosen_move = TIES[case]
    distance = 3 if case == "targets left and right" else 2
    distance = 1 if case == "frontiers above and below" else distance
    nearest = hand_made(rows, sub_goal="nearest").observations["sub_goal"][0, 0]
    check_goal(nearest[goal_set], all_moves, distance)
    assigned = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, 0]
    check_goal(assigned[goal_set], [chosen_move], distance)
    check_territory(assigned[goal_set], {move: [distance] for move in all_moves})


@pytest.mark.parametrize("sub_goal", MODES)
@pytest.mark.parametrize("distance", [1, 2, 10, 30, 57, 200, 500])
def test_nearness_is_a_power_of_the_path_length(sub_goal: str, distance: int) -> None:
    rows = ["#" * (distance + 3), "#0" + "." * (distance - 1) + "T#"]
    got = hand_made(rows, sub_goal=sub_goal).observations["sub_goal"][0, 0]
    check_goal(got[TARGET], [RIGHT], distance)


def test_widths_of_the_features() -> None:
    assert GOAL_SETS == ("frontier", "target")
    for sub_goal, width in (("nearest", 6), ("assigned", 11)):
        batch = hand_made(["#####", "#0.1#"], sub_goal=sub_goal)
        assert batch.observations["sub_goal"].shape == (1, 2, 2, width)
    batch = hand_made(["#####", "#0.1#"], sub_goal="routes")
    assert batch.observations["sub_goal"].shape == (1, 2, 3, 11)
    assert "sub_goal" not in hand_made(["#####", "#0.1#"]).observations


def test_nearest_sends_both_robots_to_the_same_target_and_a_matching_does_not() -> None:
    rows = ["############", "#.0T1...T..#"]
    nearest = hand_made(rows, sub_goal="nearest").observations["sub_goal"][0, :, TARGET]
    check_goal(nearest[0], [RIGHT], 1)
    check_goal(nearest[1], [LEFT], 1)
    assigned = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, :, TARGET]
    check_goal(assigned[0], [RIGHT], 1)
    check_goal(assigned[1], [RIGHT], 4)
    # The first target is as near to both: nobody's. The second is 6 from robot 0, 4 from robot 1.
    check_territory(assigned[0], {})
    check_territory(assigned[1], {RIGHT: [4]})


def test_the_nearest_pair_is_matched_first_whatever_the_index() -> None:
    got = hand_made(["#########", "#0..T.1.#"], sub_goal="assigned").observations["sub_goal"][0]
    check_goal(got[0, TARGET], [], None)
    check_goal(got[1, TARGET], [LEFT], 2)
    check_territory(got[0, TARGET], {})
    check_territory(got[1, TARGET], {LEFT: [2]})


def test_more_robots_than_targets() -> None:
    rows = ["##########", "#2..0T...1"]
    got = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, :, TARGET]
    check_goal(got[0], [RIGHT], 1)
    for robot in (1, 2):
        check_goal(got[robot], [], None)
    nearest = hand_made(rows, sub_goal="nearest").observations["sub_goal"][0, :, TARGET]
    check_goal(nearest[1], [LEFT], 4)
    check_goal(nearest[2], [RIGHT], 4)


def test_targets_side_by_side_go_to_different_robots() -> None:
    got = hand_made(["##########", "#0..TT..1#"], sub_goal="assigned").observations["sub_goal"][0]
    check_goal(got[0, TARGET], [RIGHT], 3)
    check_goal(got[1, TARGET], [LEFT], 3)
    check_territory(got[0, TARGET], {RIGHT: [3]})
    check_territory(got[1, TARGET], {LEFT: [3]})


def test_a_frontier_goal_blocks_its_neighbors_for_team_mates() -> None:
    # All five cells of the lower row are frontier. Robot 0 takes its own cell, which blocks robot
    # 1's; robot 2 stands farther off and takes its own, which blocks what is left for robot 1.
    rows = ["#?????#", "#01.2.#", "#######"]
    got = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, :, FRONTIER]
    check_goal(got[0], [STOP], 0)
    check_goal(got[1], [], None)
    check_goal(got[2], [STOP], 0)
    # Cell 3 is as near to robot 1 as to robot 2; cell 5 is only near to robot 2.
    check_territory(got[0], {STOP: [0]})
    check_territory(got[1], {STOP: [0]})
    check_territory(got[2], {STOP: [0], RIGHT: [1]})


def test_a_robot_whose_own_frontier_is_blocked_goes_to_the_next() -> None:
    rows = ["#?????#", "#01...#", "#######"]
    got = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, :, FRONTIER]
    check_goal(got[0], [STOP], 0)
    check_goal(got[1], [RIGHT], 1)
    check_territory(got[0], {STOP: [0]})
    check_territory(got[1], {STOP: [0], RIGHT: [1, 2, 3]})


def test_only_frontier_goals_within_one_cell_are_blocked() -> None:
    # Two corridors with a wall between: the frontier cells are two apart, so both are taken.
    rows = ["#####", "#0.?#", "#####", "#1.?#", "#####"]
    got = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, :, FRONTIER]
    check_goal(got[0], [RIGHT], 1)
    check_goal(got[1], [RIGHT], 1)


def test_a_blocked_neighborhood_does_not_stop_at_walls() -> None:
    # Two corridors that touch at a corner, without a path between; the unseen cell makes a frontier
    # of the end of one and the start of the other.
    rows = ["#######", "#0..?##", "####1.#", "#######"]
    got = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, :, FRONTIER]
    check_goal(got[0], [], None)
    check_goal(got[1], [STOP], 0)
    check_territory(got[0], {RIGHT: [2]})
    check_territory(got[1], {STOP: [0], RIGHT: [1]})


def test_robots_in_the_same_cell_own_nothing_and_take_different_targets() -> None:
    batch = hand_made(["#########", "#T...T..#"], robots=[(1, 4), (1, 4)], sub_goal="assigned")
    got = batch.observations["sub_goal"][0, :, TARGET]
    check_goal(got[0], [RIGHT], 1)
    check_goal(got[1], [LEFT], 3)
    for robot in range(2):
        check_territory(got[robot], {})


def test_territory_counts_a_goal_under_every_move_that_starts_a_shortest_path() -> None:
    rows = ["#####", "#T.0#", "#...#", "#.T.#", "#####"]
    got = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, 0, TARGET]
    # The left target is 2 straight left; the other is 2 down and 1 left: both ways are short.
    check_goal(got, [LEFT], 2)
    check_territory(got, {LEFT: [2, 3], DOWN: [3]})


def test_what_a_team_mate_cannot_reach_belongs_to_the_one_who_can() -> None:
    rows = ["##########", "#0...T#1.#", "##########"]
    got = hand_made(rows, sub_goal="assigned").observations["sub_goal"][0, :, TARGET]
    check_goal(got[0], [RIGHT], 4)
    check_goal(got[1], [], None)
    check_territory(got[0], {RIGHT: [4]})
    check_territory(got[1], {})


@pytest.mark.parametrize("sub_goal", MODES)
def test_features_follow_the_robot_and_vanish_with_the_goal(sub_goal: str) -> None:
    batch = hand_made(["#######", "#0..T.#"], sub_goal=sub_goal)
    for distance in (3, 2, 1):
        check_goal(batch.observations["sub_goal"][0, 0, TARGET], [RIGHT], distance)
        batch.step(np.array([[RIGHT]]))
    check_goal(batch.observations["sub_goal"][0, 0, TARGET], [], None)


@pytest.mark.parametrize("sub_goal", MODES)
def test_one_search_leaves_nothing_behind_for_the_next(sub_goal: str) -> None:
    """The scratch arrays are shared by teams and robots: another order gives the same features."""
    batch = hand_made(["##?####", "#0.1T.2", "#.....?"], sub_goal=sub_goal)
    first = batch.observations["sub_goal"].copy()
    assert first.any()
    for _ in range(3):
        batch.set_state(batch.get_state())
        assert np.array_equal(batch.observations["sub_goal"], first)
