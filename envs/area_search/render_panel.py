"""The side panel of a frame: title, step, metrics, robots by role and the legend of the map."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from area_search import render_style as style

if TYPE_CHECKING:
    from pygame import Surface

    from area_search.snapshot import Snapshot

PANEL_WIDTH = 212

_ROW = 21
_TITLE = 30
_SECTION_GAP = 12
_METRIC = 32
_SWATCH = 18
_TEXT = 19
_N_LEGEND_ROWS = 11

_DrawSwatch = Callable[["Surface"], None]


def panel_height(snapshot: Snapshot) -> int:
    """Height that the panel of this snapshot takes.

    :param snapshot: what is shown
    :return: pixels
    """
    n_robot_rows = 1 if snapshot.roles is None else len(snapshot.role_names)
    height = _TITLE if snapshot.title else 0
    height += 40 + len(snapshot.metrics) * _METRIC
    return height + 3 * _SECTION_GAP + (n_robot_rows + _N_LEGEND_ROWS) * _ROW


def draw_panel(snapshot: Snapshot, *, hidden: bool) -> Surface:
    """Draw the panel.

    :param snapshot: what is shown
    :param hidden: whether the map shows what lies beneath unexplored cells
    :return: an opaque surface (``PANEL_WIDTH``, ``panel_height(snapshot)``)
    """
    pygame = style.load_pygame()
    panel = pygame.Surface((PANEL_WIDTH, panel_height(snapshot)), 0, 32)
    panel.fill(style.BACKGROUND)
    y = 0
    if snapshot.title:
        title = style.fit_text(snapshot.title, 26, PANEL_WIDTH)
        style.draw_text(panel, title, 26, style.INK, left=0, center_y=y + 10)
        y += _TITLE

    style.draw_text(panel, "step", _TEXT, style.MUTED, left=0, center_y=y + 9)
    steps = f"{snapshot.step} / {snapshot.horizon}"
    style.draw_text(panel, steps, 24, style.INK, right=PANEL_WIDTH, center_y=y + 9)
    _draw_bar(panel, y + 21, snapshot.step / max(1, snapshot.horizon), style.INK)
    y += 40
    for name, value in snapshot.metrics.items():
        known = math.isfinite(value)
        percent = f"{100 * value:.1f} %" if known else "-"
        label = style.fit_text(name, _TEXT, PANEL_WIDTH - 70)
        style.draw_text(panel, label, _TEXT, style.MUTED, left=0, center_y=y + 7)
        style.draw_text(panel, percent, _TEXT, style.INK, right=PANEL_WIDTH, center_y=y + 7)
        _draw_bar(panel, y + 16, value if known else 0.0, style.ROLE_COLORS[0])
        y += _METRIC

    for section in (_robot_rows(snapshot), _legend_rows(snapshot, hidden)):
        pygame.draw.line(panel, style.RULE, (0, y), (PANEL_WIDTH, y))
        y += _SECTION_GAP
        for draw, label, note in section:
            _draw_row(panel, y, draw, label, note)
            y += _ROW
        y += _SECTION_GAP // 2
    return panel


def _draw_bar(panel: Surface, y: int, share: float, color: style.Color) -> None:
    # A metric above 100 % (explo_paper can be) fills the bar; its number tells the rest.
    filled = round(PANEL_WIDTH * min(1.0, max(0.0, share)))
    panel.fill(style.RULE, (0, y, PANEL_WIDTH, 5))
    panel.fill(color, (0, y, filled, 5))


def _draw_row(panel: Surface, y: int, draw: _DrawSwatch, label: str, note: str) -> None:
    pygame = style.load_pygame()
    side = _SWATCH * style.SUPERSAMPLE
    swatch = pygame.Surface((side, side), 0, 32)
    swatch.fill(style.BACKGROUND)
    draw(swatch)
    panel.blit(pygame.transform.smoothscale(swatch, (_SWATCH, _SWATCH)), (0, y))
    middle = y + _SWATCH / 2
    fitted = style.fit_text(label, _TEXT, PANEL_WIDTH - 66)
    style.draw_text(panel, fitted, _TEXT, style.INK, left=_SWATCH + 9, center_y=middle)
    style.draw_text(panel, note, _TEXT, style.MUTED, right=PANEL_WIDTH, center_y=middle)


def _robot_rows(snapshot: Snapshot) -> list[tuple[_DrawSwatch, str, str]]:
    def glyph(role: int | None) -> _DrawSwatch:
        def draw(swatch: Surface) -> None:
            middle = swatch.get_width() / 2
            style.draw_robot(swatch, (middle, middle), 0.46 * swatch.get_width(), role)

        return draw

    if snapshot.roles is None:
        return [(glyph(None), "robots", str(len(snapshot.position)))]
    counts = np.bincount(snapshot.roles, minlength=len(snapshot.role_names)).tolist()
    return [(glyph(role), name, str(counts[role])) for role, name in enumerate(snapshot.role_names)]


def _legend_rows(snapshot: Snapshot, hidden: bool) -> list[tuple[_DrawSwatch, str, str]]:
    pygame = style.load_pygame()

    def cell(ground: style.Color, tile: Surface | None = None) -> _DrawSwatch:
        def draw(swatch: Surface) -> None:
            swatch.fill(style.RULE)
            box = swatch.get_rect().inflate(-2, -2)
            swatch.fill(ground, box)
            if tile is not None:
                swatch.blit(tile, (0, 0), special_flags=pygame.BLEND_PREMULTIPLIED)

        return draw

    def unexplored(swatch: Surface) -> None:
        cell(style.UNEXPLORED)(swatch)
        if hidden:
            side = swatch.get_width()
            swatch.fill(style.HIDDEN_OBSTACLE, (2, 2, side // 2 - 2, side - 4))

    def disc(swatch: Surface) -> None:
        # The sensor's shape at its default radius, one block per cell.
        block = swatch.get_width() // 5
        tint = tuple(round(0.75 * 255 + 0.25 * part) for part in color)
        for inset, rows in ((0, (2,)), (1, (1, 3)), (2, (0, 4))):
            for row in rows:
                width = (5 - 2 * inset) * block
                swatch.fill(tint, (inset * block, row * block, width, block))
        border = [(2, 0), (3, 0), (3, 1), (4, 1), (4, 2), (5, 2), (5, 3), (4, 3), (4, 4), (3, 4)]
        border += [(3, 5), (2, 5), (2, 4), (1, 4), (1, 3), (0, 3), (0, 2), (1, 2), (1, 1), (2, 1)]
        pygame.draw.polygon(swatch, color, [(x * block, y * block) for x, y in border], 2)

    def window(swatch: Surface) -> None:
        box = swatch.get_rect().inflate(-4, -4)
        pygame.draw.rect(swatch, style.RULE, box, 2)
        arm = 10
        for x, inward_x in ((box.left, 1), (box.right - 1, -1)):
            for y, inward_y in ((box.top, 1), (box.bottom - 1, -1)):
                pygame.draw.line(swatch, color, (x, y), (x + inward_x * arm, y), 3)
                pygame.draw.line(swatch, color, (x, y), (x, y + inward_y * arm), 3)

    def line(width: int, ink: style.Color) -> _DrawSwatch:
        def draw(swatch: Surface) -> None:
            side = swatch.get_width()
            pygame.draw.line(swatch, ink, (2, side - 8), (side - 2, 8), width)

        return draw

    color = style.role_color(None if snapshot.roles is None else 0)
    pale = style.NEUTRAL_PATH if snapshot.roles is None else style.ROLE_COLORS[2]
    scaled = _SWATCH * style.SUPERSAMPLE
    n_seen = int((snapshot.target_open & snapshot.explored).sum())
    n_unseen = int(snapshot.target_open.sum()) - n_seen
    n_covered = int(snapshot.target_covered.sum())
    view = 2 * snapshot.view_radius + 1
    open_tile = style.target_tile(scaled, covered=False)
    covered_tile = style.target_tile(scaled, covered=True)
    faded_tile = style.target_tile(scaled, covered=False, faded=True)
    unseen_row = (cell(style.UNEXPLORED, faded_tile), "unseen target", str(n_unseen))
    return [
        (cell(style.FREE), "free", ""),
        (cell(style.OBSTACLE), "obstacle", ""),
        (unexplored, "unexplored", "truth faded" if hidden else ""),
        (cell(style.FRONTIER, style.frontier_tile(scaled)), "frontier", ""),
        (cell(style.FREE, open_tile), "open target", str(n_seen)),
        *([unseen_row] if hidden else []),
        (cell(style.FREE, covered_tile), "covered target", str(n_covered)),
        (disc, "sensor disc", f"r = {snapshot.sensor_radius:g}"),
        (window, "view window", f"{view} x {view}"),
        (line(2, style.INK), "link", f"d < {snapshot.communication_radius:g}"),
        (line(8, pale), "recent path", ""),
    ]
