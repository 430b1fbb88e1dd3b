"""The VRPC and Oracle rows: plans against brute force, hand-made maps, and what they promise."""

from __future__ import annotations

import importlib
import itertools
import json
from importlib.util import find_spec

import numpy as np
import pytest

from area_search import BatchedAreaSearch, Scene
from area_search import cells as layout
from sb3_roles.baselines import ortools_routing, road_map
from sb3_roles.baselines.greedy import GreedyAssignedController
from sb3_roles.baselines.oracle import OracleController, most_nodes
from sb3_roles.baselines.ortools_routing import improve_routes
from sb3_roles.baselines.routing import FAR, RoutingProblem, plan_routes
from sb3_roles.baselines.vrpc import RoutePlanner, VRPController
from sb3_roles.evaluation.episodes import run_episodes
from tests.helpers import DOWN, LEFT, RIGHT, STOP, UP, hand_made

needs_ortools = pytest.mark.skipif(find_spec("ortools") is None, reason="needs the extra vrp")


def random_problem(seed, n_robots, n_nodes, size=9, lateness=0):
    """Nodes on an open grid, so that distances are a metric."""
    rng = np.random.default_rng(seed)
    place = rng.integers(0, size, (n_robots + n_nodes, 2))
    distance = np.abs(place[:, None] - place[None]).sum(-1)
    return RoutingProblem(
        first=distance[:n_robots, n_robots:].copy(),
        between=distance[n_robots:, n_robots:].copy(),
        prize=rng.integers(1, 60, n_nodes),
        lateness=rng.integers(0, 1 + lateness, n_nodes),
        budget=int(rng.integers(0, 20)),
        length_weight=int(rng.integers(0, 3)),
    )


def all_plans(n_robots, n_nodes):
    """Every choice, order and split of the nodes over one or two robots."""
    for k in range(n_nodes + 1):
        for order in itertools.permutations(range(n_nodes), k):
            for cut in range(k + 1) if n_robots == 2 else (k,):
                yield [list(order[:cut]), list(order[cut:])][:n_robots]


def feasible_costs(problem):
    for routes in all_plans(*problem.first.shape):
        try:
            yield problem.cost(routes), sum(map(len, routes))
        except ValueError:
            continue


@pytest.mark.parametrize("lateness", [0, 2])
def test_plans_are_optimal_on_tiny_problems(lateness):
    dropped = 0
    for seed in range(40):
        problem = random_problem(seed, 1 + seed % 2, 1 + seed % 5, lateness=lateness)
        best, _ = min(feasible_costs(problem))
        plan = plan_routes(problem, 300)
        assert problem.cost(plan) == best
        dropped += sum(map(len, plan)) < len(problem.prize)
    assert 5 < dropped < 40


@needs_ortools
@pytest.mark.parametrize("lateness", [0, 2])
def test_ortools_is_optimal_on_tiny_problems(lateness):
    for seed in range(8):
        problem = random_problem(seed, 1 + seed % 2, 3 + seed % 3, lateness=lateness)
        plan = improve_routes(problem, 60, 60.0)
        assert problem.cost(plan) == min(feasible_costs(problem))[0]


@needs_ortools
def test_ortools_goes_on_from_a_plan_and_repeats_exactly():
    problem = random_problem(3, 2, 12, size=12)
    start = plan_routes(problem)
    plans = [improve_routes(problem, 20, 60.0, start) for _ in range(2)]
    assert plans[0] == plans[1]
    assert problem.cost(plans[0]) <= problem.cost(start)
    assert improve_routes(problem, 20, 0.0) is None


def test_more_rounds_are_never_worse_and_a_start_is_kept_or_improved():
    for seed in range(10):
        problem = random_problem(seed, 3, 20, size=15, lateness=1)
        costs = [problem.cost(plan_routes(problem, rounds)) for rounds in (0, 50, 500)]
        assert costs[1] <= costs[0] and costs[2] <= costs[0]
        start = plan_routes(problem, 50)
        assert problem.cost(plan_routes(problem, 0, start)) <= costs[1]
        assert problem.cost(plan_routes(problem, 20, start)) <= costs[1]


def test_problems_without_nodes_or_reachable_nodes_have_empty_plans():
    none = RoutingProblem(
        *(np.zeros(shape, np.int64) for shape in ((2, 0), (0, 0), 0, 0)), budget=9
    )
    assert plan_routes(none, 10) == [[], []]
    far = RoutingProblem(
        np.full((1, 2), FAR), np.array([[0, 1], [1, 0]]), np.full(2, 9), np.zeros(2, int), 50
    )
    assert plan_routes(far, 10) == [[]]
    assert most_nodes(far.first, far.between, 50) == 0


def test_costs_refuse_what_is_no_plan():
    problem = random_problem(1, 2, 3)
    with pytest.raises(ValueError, match="no node twice"):
        problem.cost([[0], [0]])
    with pytest.raises(ValueError, match="the budget is"):
        RoutingProblem(
            np.array([[5]]), np.zeros((1, 1), int), np.ones(1, int), np.zeros(1, int), budget=4
        ).cost([[0]])


def test_the_bound_of_the_oracle_is_one():
    tight = 0
    for seed in range(40):
        problem = random_problem(seed, 1 + seed % 2, 1 + seed % 5)
        most = max(visited for _, visited in feasible_costs(problem))
        bound = most_nodes(problem.first, problem.between, problem.budget)
        assert most <= bound <= len(problem.prize)
        tight += most == bound
    assert tight > 20


def walls(seed, size=9):
    rng = np.random.default_rng(seed)
    cells = np.full((size, size), layout.EXPLORED, np.uint8)
    cells[rng.random((size, size)) < 0.3] |= layout.OBSTACLE
    cells[rng.random((size, size)) < 0.1] &= ~np.uint8(layout.EXPLORED)
    cells[[0, -1]] = cells[:, [0, -1]] = layout.BORDER
    return cells


def slow_lengths(cells):
    """Floyd-Warshall over the known free cells, by flat cell."""
    size = cells.shape[1]
    free = (cells.ravel() & (layout.EXPLORED | layout.OBSTACLE)) == layout.EXPLORED
    length = np.full((cells.size, cells.size), FAR)
    for cell in np.flatnonzero(free):
        length[cell, cell] = 0
        for step in (1, -1, size, -size):
            if free[cell + step]:
                length[cell, cell + step] = 1
    for k in np.flatnonzero(free):
        length = np.minimum(length, length[:, k, None] + length[None, k])
    return free, np.minimum(length, FAR)


@pytest.mark.parametrize("seed", range(5))
def test_path_lengths_are_exact(seed):
    cells = walls(seed)
    free, slow = slow_lengths(cells)
    nodes = np.flatnonzero(free)
    fast = road_map.path_lengths(cells.ravel(), cells.shape[1], nodes, nodes)
    assert np.array_equal(fast, slow[np.ix_(nodes, nodes)])


def test_views_see_all_that_the_frontier_can_see():
    rows = ["??????", "?....?", "?....?", "......", "#.0..#"]
    batch = hand_made(rows)
    cells, stride = batch.cells[0].ravel(), batch.cells.shape[2]
    disc = layout.disc_offsets(2.0)
    frontier = np.flatnonzero(cells & layout.FRONTIER)

    def seen_from(chosen):
        seen = (chosen[:, None] + disc[:, 0] * stride + disc[:, 1]).ravel()
        return {cell for cell in seen.tolist() if not cells[cell] & layout.EXPLORED}

    views, added = road_map.new_views(cells, stride, disc, frontier, 1)
    assert seen_from(views) == seen_from(frontier)
    assert added.sum() == len(seen_from(frontier))
    assert list(added) == sorted(added, reverse=True)
    assert len(views) < len(frontier)
    fewer, _ = road_map.new_views(cells, stride, disc, frontier, 3)
    assert fewer.tolist() == [view for view, n in zip(views, added, strict=True) if n >= 3]


def first_actions(controller, batch):
    controller.begin(batch)
    return controller.act(batch)[0].tolist()


def play(controller, batch):
    """Play to the horizon; return the covered targets."""
    controller.begin(batch)
    for _ in range(batch.scene.horizon):
        batch.step(controller.act(batch))
    return batch.totals[0, 2]


KNOWING = [RoutePlanner, OracleController]


@pytest.mark.parametrize("kind", KNOWING)
@pytest.mark.parametrize(
    ("rows", "actions"),
    [
        (["T.0..", "#####"], [LEFT]),
        (["..0.T", "#####"], [RIGHT]),
        ([".0.", ".#.", "T#.", "..."], [LEFT]),
        (["#T#", "#0#", "#1#", "#T#"], [UP, DOWN]),
        (["T..01..T"], [LEFT, RIGHT]),
        (["0....", "#####"], [STOP]),
        (["0#T", "###"], [STOP]),
    ],
)
def test_first_moves_on_known_maps(kind, rows, actions):
    assert first_actions(kind(rounds=100), hand_made(rows)) == actions


@pytest.mark.parametrize("kind", KNOWING)
def test_routes_end_where_the_steps_end(kind):
    # Two targets to the left within the six steps, or one of the three to the right.
    rows = ["T.T...0.....TTT"]
    batch = hand_made(rows, horizon=6)
    options = {"interest": 0} if kind is RoutePlanner else {}
    assert play(kind(rounds=100, **options), batch) == 2
    # Out of reach: nobody sets out.
    assert first_actions(kind(rounds=100), hand_made(["0...T"], horizon=3)) == [STOP]


def test_the_shorter_way_round_or_what_is_near_first():
    # Both ends can be reached in time: left first takes 6 + 11 steps, right first 5 + 11.
    rows = ["TTTT..0....T"]
    assert first_actions(RoutePlanner(interest=0), hand_made(rows)) == [RIGHT]
    # Four targets that are soon there outweigh the step.
    assert first_actions(RoutePlanner(interest=20), hand_made(rows)) == [LEFT]


def test_robots_that_are_not_needed_come_along():
    batch = hand_made(["01.....T"])
    assert first_actions(RoutePlanner(), batch) == [RIGHT, RIGHT]
    # Too far to be worth anything on arrival, but there is nothing else to do.
    assert first_actions(RoutePlanner(interest=3), hand_made(["0......T"])) == [RIGHT]


def test_robots_take_the_way_over_targets():
    # Two shortest paths to the far target; one of them passes another.
    rows = ["0..", ".#.", "T.T"]
    batch = hand_made(rows)
    assert first_actions(OracleController(rounds=50), batch) == [DOWN]
    cells, stride = batch.cells[0].ravel(), batch.cells.shape[2]
    border = (stride - batch.scene.width) // 2
    at = [(row + border) * stride + column + border for row, column in ((0, 0), (2, 2))]
    action = np.zeros(1, np.int64)
    road_map.first_moves(cells, stride, np.array(at[:1]), np.array(at[1:]), action)
    assert action.tolist() == [DOWN]


def test_vrpc_goes_where_more_is_unseen_and_reads_nothing_hidden():
    rows = ["?...0...??", "?.......??", "?.......??", "?.......??", "?.......??"]
    for hidden in ("?", "t", "%"):
        batch = hand_made([row.replace("?", hidden) for row in rows])
        controller = RoutePlanner(cell_prize=200)
        assert first_actions(controller, batch) in ([RIGHT], [DOWN], [LEFT])
        if hidden == "?":
            expected = controller._routes
        assert controller._routes == expected


def test_the_oracle_walks_through_unknown_cells():
    batch = hand_made(["0??tt", "%%%%%"])
    assert play(OracleController(rounds=50), batch) == 2
    assert first_actions(RoutePlanner(cell_prize=0), hand_made(["0..tt", "%%%%%"])) == [STOP]


def test_plans_are_made_only_when_something_changed():
    batch = hand_made(["0........T", "#########."])
    controller = RoutePlanner()
    assert play(controller, batch) == 1
    assert controller.n_plans == 1
    batch = BatchedAreaSearch("hard", 1, horizon=20)
    counts = []
    for plan_every in (1, 5):
        batch.reset(777)
        controller = RoutePlanner(rounds=20, plan_every=plan_every)
        play(controller, batch)
        counts.append(controller.n_plans)
    assert 1 < counts[1] <= counts[0] <= 20


SMALL = Scene(name="small", height=15, width=15, n_targets=25, n_agents=3, horizon=25)


def outcome(controller, scene, n=6, **options):
    return run_episodes(controller, scene, n, seed=777, **options).curves


@pytest.mark.parametrize(
    "make",
    [
        lambda: RoutePlanner(rounds=30),
        lambda: OracleController(rounds=200),
        pytest.param(lambda: VRPController(solutions=2, seconds=60.0), marks=needs_ortools),
    ],
    ids=["planner", "oracle", "vrpc"],
)
def test_episodes_do_not_depend_on_the_batch(make):
    n = 3 if isinstance(make(), VRPController) else 6
    controller = make()
    together = outcome(controller, SMALL, n)
    for curves in (outcome(make(), SMALL, n, batch_size=1), outcome(controller, SMALL, n)):
        assert all(np.array_equal(curves[name], together[name]) for name in together)


def test_knowing_more_covers_more():
    cover = [
        100 * outcome(controller, "hard", 10)["cover"][:, -1].mean()
        for controller in (
            OracleController(rounds=3000),
            RoutePlanner(rounds=200),
            RoutePlanner(rounds=0, seconds=0.0),
            GreedyAssignedController(),
        )
    ]
    assert cover[0] > 85 > max(cover[1:])
    assert min(cover[1], cover[3]) > 60
    assert cover[2] > 55


def test_the_plan_of_the_oracle_is_carried_out_and_bounded():
    batch = BatchedAreaSearch("easy", 1)
    batch.reset(777)
    controller = OracleController(rounds=300)
    covered = play(controller, batch)
    assert controller.n_plans == 1
    assert controller.planned[0] <= covered <= controller.bounds[0] <= 4 * 50
    # In records each episode keeps its own.
    records = run_episodes(OracleController(rounds=50), SMALL, 5, seed=3, batch_size=2)
    alone = run_episodes(OracleController(rounds=50), SMALL, 2, seed=3, first_episode=3)
    assert np.array_equal(records.bounds[3:], alone.bounds)
    assert np.all(records.counts["covered"][:, -1] <= records.bounds)
    assert len(set(records.bounds)) > 1
    # Targets that are seen, not covered, count for the other metric.
    seen = outcome(OracleController(rounds=1000, cell_prize=0), SMALL)["explo_paper"][:, -1]
    more = outcome(OracleController(rounds=1000, cell_prize=1000), SMALL)["explo_paper"][:, -1]
    assert more.mean() > seen.mean()


@pytest.mark.parametrize("n_agents", [1, 15, 50])
def test_teams_of_any_size_are_planned_for(n_agents):
    scene = Scene(name="crowd", n_agents=n_agents, horizon=10)
    cover = outcome(RoutePlanner(rounds=10, nodes_per_robot=8), scene, 2)["cover"]
    assert 0 < cover[:, -1].mean() < 1


@needs_ortools
def test_no_time_for_ortools_still_gives_the_greedy_plan():
    quick = VRPController(solutions=5, seconds=0.0)
    curves = outcome(quick, SMALL, 2)
    greedy = outcome(RoutePlanner(rounds=0, interest=0), SMALL, 2)
    assert np.array_equal(curves["cover"], greedy["cover"])
    assert curves["cover"][:, -1].min() > 0


def test_a_missing_ortools_is_one_clear_line(monkeypatch):
    def missing(name):
        if name.startswith("ortools"):
            raise ModuleNotFoundError(f"No module named {name!r}")
        return importlib.import_module(name)

    monkeypatch.setattr(ortools_routing, "import_module", missing)
    with pytest.raises(ImportError, match=r"pip install sb3_roles\[vrp\]") as caught:
        VRPController()
    assert "\n" not in str(caught.value) and "controller vrpc" in str(caught.value)
    # Our own solver does without.
    assert first_actions(RoutePlanner(), hand_made(["0.T"])) == [RIGHT]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rounds": -1}, "rounds must be a whole number of at least 0, got -1"),
        ({"rounds": 1.5}, "rounds must be a whole number"),
        ({"seconds": -1.0}, "seconds must be a number from 0"),
        ({"seconds": float("nan")}, "seconds must be a number from 0"),
        ({"target_prize": True}, "target_prize must be a whole number"),
    ],
)
@pytest.mark.parametrize("kind", KNOWING)
def test_options_are_checked_and_described(kind, options, message):
    with pytest.raises(ValueError, match=message):
        kind(**options)
    described = kind(rounds=np.int64(7)).description
    assert json.loads(json.dumps(described)) == described
    assert described["rounds"] == 7
    assert kind(rounds=8).description != described
