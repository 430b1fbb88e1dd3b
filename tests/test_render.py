from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from area_search.render import Window, default_cell_size, draw_frame, map_origin
from area_search.render_map import sensed_cells
from area_search.render_style import NEUTRAL_ROBOT, ROLE_COLORS
from area_search.snapshot import Snapshot


def make_snapshot(height: int = 15, width: int = 15, **changes: Any) -> Snapshot:
    """An explored map without obstacles or targets and one robot in its middle."""
    empty = np.zeros((height, width), dtype=bool)
    fields: dict[str, Any] = {
        "obstacle": empty,
        "explored": ~empty,
        "frontier": empty,
        "target_open": empty,
        "target_covered": empty,
        "position": np.array([[height // 2, width // 2]]),
        "step": 3,
        "horizon": 50,
        "metrics": {"explo_paper": 1.04, "explo_true": 0.84, "cover": 0.2},
        "sensor_radius": 2.0,
        "view_radius": 4,
        "communication_radius": 10.0,
    }
    return Snapshot(**(fields | changes))


def make_busy_snapshot(
    height: int, width: int, n_agents: int, *, with_roles: bool = True, seed: int = 0
) -> Snapshot:
    """A random map with everything on it; obstacles, frontier and targets do not overlap."""
    rng = np.random.default_rng(seed)
    kind = rng.integers(5, size=(height, width))
    explored = rng.random((height, width)) < 0.6
    limits = (height, width)
    return make_snapshot(
        height,
        width,
        obstacle=kind == 0,
        explored=explored,
        frontier=(kind == 1) & explored,
        target_open=kind == 2,
        target_covered=(kind == 3) & explored,
        position=rng.integers(limits, size=(n_agents, 2)),
        roles=rng.integers(2, size=n_agents) if with_roles else None,
        path=rng.integers(limits, size=(7, n_agents, 2)),
        title="a busy map",
    )


def map_pixels(snapshot: Snapshot, frame: np.ndarray, cell: int) -> np.ndarray:
    """The map by cells, uint8 (H, W, cell, cell, 3)."""
    height, width = snapshot.obstacle.shape
    top, left = map_origin(snapshot, cell)
    chart = frame[top : top + height * cell, left : left + width * cell]
    return chart.reshape(height, cell, width, cell, 3).swapaxes(1, 2)


def changed_cells(before: Snapshot, after: Snapshot, cell: int = 24) -> set[tuple[int, int]]:
    first = map_pixels(before, draw_frame(before, cell), cell)
    second = map_pixels(after, draw_frame(after, cell), cell)
    rows, columns = np.nonzero((first != second).any(axis=(2, 3, 4)))
    return set(zip(rows.tolist(), columns.tolist(), strict=True))


def has_color(pixels: np.ndarray, color: tuple[int, int, int]) -> bool:
    return bool((pixels == color).all(axis=-1).any())


@pytest.mark.parametrize("with_roles", [True, False])
@pytest.mark.parametrize(
    ("height", "width", "n_agents"),
    [(5, 5, 1), (5, 5, 50), (25, 25, 15), (100, 60, 50), (60, 101, 4), (200, 200, 50), (1, 7, 2)],
)
def test_frame_is_an_even_sized_rgb_image(
    height: int, width: int, n_agents: int, with_roles: bool
) -> None:
    snapshot = make_busy_snapshot(height, width, n_agents, with_roles=with_roles)
    frame = draw_frame(snapshot)
    assert frame.dtype == np.uint8
    assert frame.ndim == 3 and frame.shape[2] == 3
    assert frame.shape[0] % 2 == 0 and frame.shape[1] % 2 == 0
    assert frame.shape[0] > height * default_cell_size((height, width))
    assert frame.flags.c_contiguous and frame.flags.writeable


@pytest.mark.parametrize(("size", "cell"), [(5, 120), (25, 24), (200, 3), (1000, 2)])
def test_default_cell_size_makes_a_map_of_600_pixels(size: int, cell: int) -> None:
    assert default_cell_size((size, size)) == cell
    assert default_cell_size((size // 2, size)) == cell


@pytest.mark.parametrize("cell_size", [2, 3, 5, 7, 8, 13, 40])
def test_any_cell_size_from_two_on_gives_an_even_frame(cell_size: int) -> None:
    frame = draw_frame(make_busy_snapshot(9, 11, 5), cell_size)
    assert frame.shape[0] % 2 == 0 and frame.shape[1] % 2 == 0


def test_cell_size_below_two_is_refused() -> None:
    with pytest.raises(ValueError, match="cell_size must be at least 2 pixels, got 1"):
        draw_frame(make_snapshot(), 1)


def test_same_snapshot_gives_the_same_bytes() -> None:
    first = draw_frame(make_busy_snapshot(25, 25, 15))
    draw_frame(make_busy_snapshot(10, 10, 3, seed=1))
    assert first.tobytes() == draw_frame(make_busy_snapshot(25, 25, 15)).tobytes()


def test_drawing_leaves_the_snapshot_as_it_was() -> None:
    snapshot, twin = make_busy_snapshot(12, 12, 4), make_busy_snapshot(12, 12, 4)
    draw_frame(snapshot)
    for name in ("obstacle", "explored", "frontier", "target_open", "position", "roles", "path"):
        np.testing.assert_array_equal(getattr(snapshot, name), getattr(twin, name))


@pytest.mark.parametrize("cell", [3, 6, 24])
def test_targets_show_in_their_cell_and_look_different_once_covered(cell: int) -> None:
    target = np.zeros((15, 15), dtype=bool)
    target[2, 12] = True
    bare = make_snapshot()
    is_open = make_snapshot(target_open=target)
    covered = make_snapshot(target_covered=target)
    assert changed_cells(bare, is_open, cell) == {(2, 12)}
    assert changed_cells(bare, covered, cell) == {(2, 12)}
    assert changed_cells(is_open, covered, cell) == {(2, 12)}
    luminance = [
        map_pixels(shot, draw_frame(shot, cell), cell)[2, 12].mean() for shot in (is_open, covered)
    ]
    assert luminance[0] < luminance[1] - 10, "the two must differ in gray as well"


@pytest.mark.parametrize("field", ["obstacle", "frontier"])
def test_obstacles_and_frontier_show_in_their_cells(field: str) -> None:
    mask = np.zeros((15, 15), dtype=bool)
    mask[1, 3] = mask[13, 0] = True
    changes: dict[str, Any] = {field: mask}
    assert changed_cells(make_snapshot(), make_snapshot(**changes)) == {(1, 3), (13, 0)}


@pytest.mark.parametrize("cell", [3, 6, 24])
def test_robots_take_the_color_of_their_role(cell: int) -> None:
    position = np.array([[3, 3], [11, 11]])
    snapshot = make_snapshot(position=position, roles=np.array([0, 1]))
    pixels = map_pixels(snapshot, draw_frame(snapshot, cell), cell)
    for (row, column), role in zip(position, (0, 1), strict=True):
        assert has_color(pixels[row, column], ROLE_COLORS[role])
        assert not has_color(pixels[row, column], ROLE_COLORS[1 - role])

    neutral = make_snapshot(position=position)
    pixels = map_pixels(neutral, draw_frame(neutral, cell), cell)
    for row, column in position:
        assert has_color(pixels[row, column], NEUTRAL_ROBOT)


@pytest.mark.parametrize("n_agents", [2, 3, 4, 6, 9])
def test_robots_that_share_a_cell_are_all_visible(n_agents: int) -> None:
    # The last robot is the only one of its role, so its color proves that it is seen; every
    # robot takes that place once.
    position = np.full((n_agents, 2), 7)
    for robot in range(n_agents):
        roles = np.zeros(n_agents, dtype=int)
        roles[robot] = 1
        snapshot = make_snapshot(position=position, roles=roles)
        cell = map_pixels(snapshot, draw_frame(snapshot, 24), 24)[7, 7]
        assert has_color(cell, ROLE_COLORS[0]) and has_color(cell, ROLE_COLORS[1])


@pytest.mark.parametrize(
    ("position", "radius", "linked"),
    [
        ([[7, 1], [7, 13]], 12.0, False),
        ([[7, 1], [7, 13]], 12.01, True),
        ([[4, 3], [10, 11]], 10.0, False),
        ([[4, 3], [10, 11]], 10.1, True),
    ],
)
def test_a_link_shows_between_robots_strictly_within_the_radius(
    position: list[list[int]], radius: float, linked: bool
) -> None:
    robots = np.array(position)
    alone = make_snapshot(position=robots, communication_radius=0.0)
    changed = changed_cells(alone, make_snapshot(position=robots, communication_radius=radius))
    if linked:
        assert (7, 7) in changed, "the link passes half way between the robots"
    else:
        assert changed == set()


def test_the_path_shows_where_the_robot_was() -> None:
    path = np.array([[[2, 7]], [[3, 7]], [[4, 7]]])
    changed = changed_cells(make_snapshot(), make_snapshot(path=path))
    assert {(2, 7), (3, 7), (4, 7)} <= changed
    assert all(column == 7 for _, column in changed)
    assert changed_cells(make_snapshot(), make_snapshot(path=path[:0])) == set()


def test_sensor_and_view_window_show_around_the_robot() -> None:
    disc = changed_cells(make_snapshot(sensor_radius=1.0), make_snapshot(sensor_radius=2.0))
    assert {(5, 7), (9, 7), (7, 5), (7, 9), (6, 6), (8, 8)} <= disc
    assert (5, 5) not in disc
    window = changed_cells(make_snapshot(view_radius=3), make_snapshot(view_radius=4))
    assert {(3, 3), (11, 11), (3, 11), (11, 3)} <= window


@pytest.mark.parametrize(("radius", "n_cells"), [(0.0, 1), (1.0, 5), (1.5, 9), (2.0, 13)])
def test_sensed_cells_are_those_of_the_euclidean_disc(radius: float, n_cells: int) -> None:
    assert sensed_cells(radius).sum() == n_cells


@pytest.mark.parametrize("cell", [3, 6, 24])
def test_hidden_changes_unexplored_cells_only(cell: int) -> None:
    snapshot = make_busy_snapshot(25, 25, 6)
    with_truth = map_pixels(snapshot, draw_frame(snapshot, cell, hidden=True), cell)
    opaque = map_pixels(snapshot, draw_frame(snapshot, cell, hidden=False), cell)
    changed = (with_truth != opaque).any(axis=(2, 3, 4))
    assert not changed[snapshot.explored].any()
    assert changed[~snapshot.explored & snapshot.obstacle].mean() > 0.9
    assert changed[~snapshot.explored & snapshot.target_open].mean() > 0.9


@pytest.mark.parametrize("cell", [3, 6, 24])
def test_opaque_unexplored_cells_do_not_leak_the_truth(cell: int) -> None:
    unknown = np.zeros((15, 15), dtype=bool)
    truth = np.zeros((15, 15), dtype=bool)
    truth[1:3, 1:5] = True
    frames = []
    for obstacle, target in ((truth, truth ^ True), (truth ^ True, truth)):
        snapshot = make_snapshot(explored=unknown, obstacle=obstacle, target_open=target)
        frame = draw_frame(snapshot, cell, hidden=False)
        frames.append(map_pixels(snapshot, frame, cell))
    np.testing.assert_array_equal(frames[0], frames[1])


def test_the_panel_shows_step_metrics_and_title() -> None:
    base = draw_frame(make_snapshot(), 24)
    others: list[dict[str, Any]] = [
        {"step": 4},
        {"metrics": {"explo_paper": 0.1}},
        {"horizon": 60},
    ]
    for changes in others:
        other = make_snapshot(**changes)
        frame = draw_frame(other, 24)
        assert frame.shape != base.shape or (frame != base).any()
    draw_frame(make_snapshot(title="a title much too long for the side panel " * 3))
    draw_frame(make_snapshot(metrics={"cover": float("nan")}))
    draw_frame(make_snapshot(metrics={}, horizon=0, communication_radius=float("inf")))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"obstacle": np.zeros(15, dtype=bool)}, "obstacle must have shape"),
        ({"explored": np.zeros((15, 14), dtype=bool)}, "explored must have shape"),
        ({"target_open": np.zeros((15, 15))}, "target_open must have dtype bool"),
        ({"position": np.zeros((0, 2), dtype=int)}, "position must hold at least one robot"),
        ({"position": np.zeros((2, 3), dtype=int)}, "position must have shape"),
        ({"position": np.zeros((1, 2))}, "position must have dtype integer"),
        ({"position": np.array([[15, 0]])}, "position must lie on the map"),
        ({"roles": np.zeros(2, dtype=int)}, "roles must have shape"),
        ({"roles": np.array([2])}, "roles must be indices into role_names"),
        ({"path": np.zeros((4, 2, 2), dtype=int)}, "path must have shape"),
    ],
)
def test_a_malformed_snapshot_is_refused_in_one_line(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        make_snapshot(**changes)
    assert "\n" not in str(caught.value)


def test_window_opens_follows_the_frame_size_and_closes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    import pygame

    window = Window("test")
    assert not window.is_open
    frame = np.full((40, 60, 3), (10, 200, 30), dtype=np.uint8)
    try:
        assert window.show(frame, fps=0)
        assert window.is_open
        screen = pygame.display.get_surface()
        assert screen.get_size() == (60, 40)
        assert tuple(screen.get_at((5, 5)))[:3] == (10, 200, 30)
        assert window.show(frame[:20], fps=1000)
        assert pygame.display.get_surface().get_size() == (60, 20)
        pygame.event.post(pygame.event.Event(pygame.QUIT))
        assert not window.show(frame, fps=0)
        assert not window.is_open
        assert not window.show(frame, fps=0), "a window that the user closed stays closed"
    finally:
        window.close()
        window.close()
    # Frames can still be drawn, with the same result, after a window and after pygame.quit().
    before = draw_frame(make_busy_snapshot(8, 8, 3))
    pygame.quit()
    assert before.tobytes() == draw_frame(make_busy_snapshot(8, 8, 3)).tobytes()


@pytest.mark.parametrize("frame", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3))])
def test_window_refuses_what_is_not_a_frame(frame: np.ndarray) -> None:
    with pytest.raises(ValueError, match="frame must be uint8"):
        Window().show(frame, fps=0)


def test_pygame_is_imported_late_without_greeting_and_without_display() -> None:
    code = (
        "import sys, numpy as np, area_search.render as r\n"
        "assert 'pygame' not in sys.modules\n"
        "z = np.zeros((5, 5), bool)\n"
        "r.draw_frame(r.Snapshot(obstacle=z, explored=z, frontier=z, target_open=z,"
        " target_covered=z, position=np.array([[1, 1]]), step=0, horizon=1, metrics={},"
        " sensor_radius=2.0, view_radius=4, communication_radius=10.0))\n"
        "assert not sys.modules['pygame'].display.get_init()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr
