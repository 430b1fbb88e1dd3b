"""The map of a frame: cells, targets, sensors, view windows, links, paths and robots."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from area_search import render_style as style

if TYPE_CHECKING:
    from pygame import Surface

    from area_search.snapshot import Snapshot

# Below these final cell sizes, in pixels, a detail would be noise and is left out.
_GRID_FROM = 8
_HATCH_FROM = 8
_TARGET_GLYPH_FROM = 5
_SENSOR_OUTLINE_FROM = 4
_ID_RADIUS_FROM = 5.5

# A robot stays findable on a map of tiny cells by outgrowing its cell.
_MIN_ROBOT_RADIUS = 4.0
# On a map of huge cells it leaves its cell's target and grid in sight.
_MAX_ROBOT_RADIUS = 30.0

# With more robots than this, paths are shortened and thinned.
_CROWD = 8
_PATH_STEPS = 12
_CROWD_PATH_STEPS = 5
_SENSOR_TINT = 0.16

_Point = tuple[float, float]


def draw_map(snapshot: Snapshot, cell: int, *, hidden: bool) -> Surface:
    """Draw the map alone.

    :param snapshot: what to draw
    :param cell: side of a cell in pixels
    :param hidden: show faintly what lies beneath unexplored cells
    :return: an opaque surface (W * cell, H * cell)
    """
    pygame = style.load_pygame()
    height, width = snapshot.obstacle.shape
    cells = pygame.Surface((width, height), 0, 32)
    pygame.surfarray.blit_array(cells, _cell_colors(snapshot, cell, hidden).swapaxes(0, 1))
    result = pygame.transform.scale(cells, (width * cell, height * cell))
    _draw_cell_details(result, snapshot, cell, hidden)

    # Shapes overwrite each other on the overlay, so crossings do not add up to dark spots.
    scaled = cell * style.SUPERSAMPLE
    overlay = pygame.Surface((width * scaled, height * scaled), pygame.SRCALPHA, 32)
    _draw_view_windows(overlay, snapshot, scaled)
    if cell >= _SENSOR_OUTLINE_FROM:
        _draw_sensor_outlines(overlay, snapshot, scaled)
    _draw_links(overlay, snapshot, scaled)
    _draw_paths(overlay, snapshot, scaled)
    places = _robot_places(snapshot.position, cell)
    for robot, (center, radius) in enumerate(places):
        at = (center[0] * style.SUPERSAMPLE, center[1] * style.SUPERSAMPLE)
        style.draw_robot(overlay, at, radius * style.SUPERSAMPLE, _role(snapshot, robot))
    overlay = pygame.transform.smoothscale(overlay, result.get_size())
    result.blit(overlay, (0, 0), special_flags=pygame.BLEND_PREMULTIPLIED)

    for robot, (center, radius) in enumerate(places):
        if radius >= _ID_RADIUS_FROM:
            color = style.text_color(style.role_color(_role(snapshot, robot)))
            share = 1.9 if robot < 10 else 1.55
            size_of_id = min(40, max(12, round(share * radius)))
            style.draw_text(
                result, str(robot), size_of_id, color, center_x=center[0], center_y=center[1]
            )
    return result


def sensed_cells(radius: float) -> np.ndarray:
    """Cells within ``radius`` of the middle one, by Euclidean distance between centers.

    :param radius: in cells; 2 gives the 13 cells of the paper's sensor
    :return: bool (2 * r + 1, 2 * r + 1) with r the integer part of ``radius``
    """
    reach = np.arange(-int(radius), int(radius) + 1)
    return reach[:, None] ** 2 + reach[None, :] ** 2 <= radius**2


def _role(snapshot: Snapshot, robot: int) -> int | None:
    return None if snapshot.roles is None else int(snapshot.roles[robot])


def _cell_colors(snapshot: Snapshot, cell: int, hidden: bool) -> np.ndarray:
    """Ground color of every cell, uint8 (H, W, 3)."""
    colors = np.empty((*snapshot.obstacle.shape, 3), dtype=np.uint8)
    colors[:] = style.FREE
    colors[snapshot.obstacle] = style.OBSTACLE
    colors[snapshot.frontier] = style.FRONTIER
    _tint_sensed(colors, snapshot)
    if cell < _TARGET_GLYPH_FROM:
        colors[snapshot.target_covered] = style.TARGET_COVERED_PALE
        colors[snapshot.target_open] = style.TARGET_EDGE
    colors[~snapshot.explored] = style.UNEXPLORED
    if hidden:
        colors[~snapshot.explored & snapshot.obstacle] = style.HIDDEN_OBSTACLE
        if cell < _TARGET_GLYPH_FROM:
            colors[~snapshot.explored & snapshot.target_open] = style.HIDDEN_TARGET
    return colors


def _tint_sensed(colors: np.ndarray, snapshot: Snapshot) -> None:
    """Blend, in place, the cells sensed by the robots of each role with the color of that role."""
    height, width = snapshot.obstacle.shape
    offsets = np.argwhere(sensed_cells(snapshot.sensor_radius)) - int(snapshot.sensor_radius)
    roles: list[int | None] = [None]
    if snapshot.roles is not None:
        roles = [int(role) for role in np.unique(snapshot.roles)]
    for role in roles:
        members = snapshot.position if role is None else snapshot.position[snapshot.roles == role]
        cells = (members[:, None] + offsets).reshape(-1, 2)
        cells = cells[((cells >= 0) & (cells < (height, width))).all(axis=1)]
        sensed = np.zeros((height, width), dtype=bool)
        sensed[cells[:, 0], cells[:, 1]] = True
        share = _SENSOR_TINT if role is not None else 0.5 * _SENSOR_TINT
        blend = (1 - share) * colors[sensed] + share * np.array(style.role_color(role))
        colors[sensed] = blend.astype(np.uint8)


def _draw_cell_details(chart: Surface, snapshot: Snapshot, cell: int, hidden: bool) -> None:
    """Hatching, grid lines and target glyphs."""
    pygame = style.load_pygame()

    def stamp(tile: Surface, mask: np.ndarray) -> None:
        rows, columns = np.nonzero(mask)
        corners = zip((columns * cell).tolist(), (rows * cell).tolist(), strict=True)
        area, flag = tile.get_rect(), pygame.BLEND_PREMULTIPLIED
        chart.blits([(tile, corner, area, flag) for corner in corners], doreturn=False)

    if cell >= _HATCH_FROM:
        stamp(style.frontier_tile(cell), snapshot.frontier & snapshot.explored)
    if cell >= _GRID_FROM:
        width, height = chart.get_size()
        for x in range(0, width, cell):
            chart.fill((14, 14, 14), (x, 0, 1, height), pygame.BLEND_RGB_SUB)
        for y in range(0, height, cell):
            chart.fill((14, 14, 14), (0, y, width, 1), pygame.BLEND_RGB_SUB)
    if cell >= _TARGET_GLYPH_FROM:
        if hidden:
            faded = style.target_tile(cell, covered=False, faded=True)
            stamp(faded, snapshot.target_open & ~snapshot.explored)
        covered = style.target_tile(cell, covered=True)
        stamp(covered, snapshot.target_covered & snapshot.explored)
        is_open = style.target_tile(cell, covered=False)
        stamp(is_open, snapshot.target_open & snapshot.explored)


def _draw_view_windows(overlay: Surface, snapshot: Snapshot, scaled: int) -> None:
    """A faint outline with firm corners, so that many windows stay apart."""
    pygame = style.load_pygame()
    n_agents = len(snapshot.position)
    side = (2 * snapshot.view_radius + 1) * scaled
    faint, firm = max(14, 110 - 6 * n_agents), max(90, 200 - 4 * n_agents)
    boxes = []
    for robot, (row, column) in enumerate(snapshot.position.tolist()):
        corner = (column - snapshot.view_radius, row - snapshot.view_radius)
        box = pygame.Rect(corner[0] * scaled, corner[1] * scaled, side, side)
        # The map cuts the windows of robots near its border.
        box = box.clip(overlay.get_rect())
        boxes.append((box, style.role_color(_role(snapshot, robot))))
    for box, color in boxes:
        pygame.draw.rect(overlay, style.translucent(color, faint), box, 2)
    arm = max(6, min(round(0.8 * scaled), side // 6))
    for box, color in boxes:
        for x, inward_x in ((box.left, 1), (box.right, -1)):
            for y, inward_y in ((box.top, 1), (box.bottom, -1)):
                across = pygame.Rect(x, y, inward_x * arm, inward_y * 3)
                along = pygame.Rect(x, y, inward_x * 3, inward_y * arm)
                for bar in (across, along):
                    bar.normalize()
                    overlay.fill(style.translucent(color, firm), bar)


def _draw_sensor_outlines(overlay: Surface, snapshot: Snapshot, scaled: int) -> None:
    """The outer border of the set of cells that each robot senses."""
    pygame = style.load_pygame()
    reach = int(snapshot.sensor_radius)
    sensed = np.pad(sensed_cells(snapshot.sensor_radius), 1)
    alpha = max(80, 170 - 3 * len(snapshot.position))
    # Entry i of a difference lies between padded cells i and i + 1, that is on the far side of i.
    across = np.argwhere(np.diff(sensed, axis=0)) - (reach, reach + 1)
    along = np.argwhere(np.diff(sensed, axis=1)) - (reach + 1, reach)
    for robot, (row, column) in enumerate(snapshot.position.tolist()):
        color = style.translucent(style.role_color(_role(snapshot, robot)), alpha)
        for edges, step_x, step_y in ((across, 1, 0), (along, 0, 1)):
            for d_row, d_column in edges.tolist():
                x, y = (column + d_column) * scaled, (row + d_row) * scaled
                end = (x + step_x * scaled, y + step_y * scaled)
                pygame.draw.line(overlay, color, (x, y), end, 2)


def _draw_links(overlay: Surface, snapshot: Snapshot, scaled: int) -> None:
    """A line between any two robots nearer than the communication radius (strictly)."""
    pygame = style.load_pygame()
    position = snapshot.position.astype(np.float64)
    distance = np.linalg.norm(position[:, None] - position[None, :], axis=-1)
    pairs = np.argwhere(np.triu(distance < snapshot.communication_radius, k=1)).tolist()
    centers = [_center(at, scaled) for at in snapshot.position.tolist()]
    ink = style.translucent(style.INK, max(40, 170 - len(pairs)))
    casing = style.translucent(style.WHITE, 130)
    if len(pairs) <= 80:
        # The pale casing keeps a link visible on obstacles.
        for first, second in pairs:
            pygame.draw.line(overlay, casing, centers[first], centers[second], 6)
    for first, second in pairs:
        pygame.draw.line(overlay, ink, centers[first], centers[second], 2)


def _draw_paths(overlay: Surface, snapshot: Snapshot, scaled: int) -> None:
    """The last steps of every robot, fading with age."""
    if snapshot.path is None or len(snapshot.path) == 0:
        return
    pygame = style.load_pygame()
    crowded = len(snapshot.position) > _CROWD
    n_steps = _CROWD_PATH_STEPS if crowded else _PATH_STEPS
    trail = np.concatenate([snapshot.path[-n_steps:], snapshot.position[None]])
    width = max(3, min(24, round((0.14 if crowded else 0.2) * scaled)))
    for age in range(len(trail) - 1):
        alpha = 40 + round(130 * (age + 1) / (len(trail) - 1))
        for robot, (start, end) in enumerate(
            zip(trail[age].tolist(), trail[age + 1].tolist(), strict=True)
        ):
            if start == end:
                continue
            role = _role(snapshot, robot)
            # Paths of neutral robots in black would be taken for links.
            ink = style.NEUTRAL_PATH if role is None else style.role_color(role)
            color = style.translucent(ink, alpha)
            ends = _center(start, scaled), _center(end, scaled)
            pygame.draw.line(overlay, color, *ends, width)
            for point in ends:
                pygame.draw.circle(overlay, color, point, width / 2)


def _center(place: Sequence[int], scaled: int) -> _Point:
    """Middle, as x and y, of the cell at a (row, column)."""
    row, column = place
    return ((column + 0.5) * scaled, (row + 0.5) * scaled)


def _robot_places(position: np.ndarray, cell: int) -> list[tuple[_Point, float]]:
    """Center (x, y) and radius of every robot's glyph, in final pixels.

    Robots that share a cell stand side by side in it, in the order of their ids.
    """
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for robot, (row, column) in enumerate(position.tolist()):
        groups[(row, column)].append(robot)
    places: list[tuple[_Point, float]] = [((0.0, 0.0), 0.0)] * len(position)
    for (row, column), robots in groups.items():
        middle = ((column + 0.5) * cell, (row + 0.5) * cell)
        if len(robots) == 2:
            # The diagonal leaves two robots more room than a 2 x 2 grid.
            slots, share = [(-0.2, -0.2), (0.2, 0.2)], 0.3
        else:
            side = math.ceil(math.sqrt(len(robots)))
            # Up to four robots may lean out of the cell a little, so that their ids fit.
            pitch, share = (0.58, 0.29) if side == 2 else (1 / side, 0.48 / side)
            ticks = [pitch * (index - (side - 1) / 2) for index in range(side)]
            slots = [(x, y) for y in ticks for x in ticks]
            share = min(share, 0.46)
        smallest = _MIN_ROBOT_RADIUS if len(robots) == 1 else 0.75 * _MIN_ROBOT_RADIUS
        radius = min(max(share * cell, smallest), _MAX_ROBOT_RADIUS)
        # Glyphs kept above their share of the cell spread out of it, to remain visible.
        spread = cell * max(1.0, radius / (share * cell) * 0.8)
        for robot, (x, y) in zip(robots, slots, strict=False):
            places[robot] = ((middle[0] + x * spread, middle[1] + y * spread), radius)
    return places
