"""Palette, glyphs and fonts shared by the map and the side panel of a frame.

The hues are those of Okabe and Ito, which remain apart for color-blind viewers. Nothing is told by
hue alone: roles also differ in shape, open and covered targets in shape and brightness.
"""

from __future__ import annotations

import math
import os
from functools import lru_cache
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pygame

Color = tuple[int, int, int]

BACKGROUND: Color = (246, 247, 248)
INK: Color = (33, 37, 43)
MUTED: Color = (112, 118, 128)
RULE: Color = (218, 221, 226)
WHITE: Color = (255, 255, 255)

FREE: Color = (255, 255, 255)
OBSTACLE: Color = (72, 78, 88)
UNEXPLORED: Color = (198, 202, 208)
HIDDEN_OBSTACLE: Color = (171, 176, 184)
HIDDEN_TARGET: Color = (208, 172, 192)
FRONTIER: Color = (250, 240, 150)
FRONTIER_HATCH: Color = (222, 203, 62)
TARGET_OPEN: Color = (204, 121, 167)
TARGET_EDGE: Color = (138, 54, 101)
TARGET_COVERED: Color = (0, 158, 115)
TARGET_COVERED_PALE: Color = (150, 215, 193)

NEUTRAL_ROBOT: Color = (0, 0, 0)
NEUTRAL_PATH: Color = (128, 134, 144)
ROLE_COLORS: tuple[Color, ...] = (
    (0, 114, 178),  # blue
    (230, 159, 0),  # orange
    (86, 180, 233),  # sky blue
    (213, 94, 0),  # vermilion
    (0, 158, 115),  # bluish green
    (240, 228, 66),  # yellow
)

# Shapes are drawn at this multiple of their final size and averaged down: pygame's own
# antialiased primitives cover neither thick lines nor filled shapes. Averaging is only right for
# colors premultiplied by their alpha, hence :func:`translucent` and ``BLEND_PREMULTIPLIED``.
SUPERSAMPLE = 2

# Number of sides of the glyph of each role; 0 stands for a circle.
_ROLE_SIDES = (0, 4, 3, 6, 5)


def load_pygame() -> ModuleType:
    """Import pygame on first use, without its greeting, and start its font module.

    The display module is left alone, so that frames can be drawn where there is no screen.

    :return: the module ``pygame``
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    import pygame

    if not pygame.font.get_init():
        pygame.font.init()
    return pygame


def role_color(role: int | None) -> Color:
    """Color of a robot.

    :param role: index of its role, None for a robot without one
    :return: red, green, blue in 0..255
    """
    return NEUTRAL_ROBOT if role is None else ROLE_COLORS[role % len(ROLE_COLORS)]


def translucent(color: Color, alpha: int) -> tuple[int, int, int, int]:
    """A color premultiplied by its alpha.

    :param color: red, green, blue in 0..255
    :param alpha: 0 (clear) to 255 (opaque)
    :return: red, green, blue, alpha in 0..255
    """
    red, green, blue = (round(part * alpha / 255) for part in color)
    return red, green, blue, alpha


def text_color(background: Color) -> Color:
    """White or ink, whichever reads better on ``background``.

    :param background: red, green, blue in 0..255
    :return: red, green, blue in 0..255
    """
    red, green, blue = background
    return INK if 0.299 * red + 0.587 * green + 0.114 * blue > 130 else WHITE


def draw_robot(
    surface: pygame.Surface, center: tuple[float, float], radius: float, role: int | None
) -> None:
    """Draw a robot: circle, square, triangle, ... by role, with a white halo.

    :param surface: where to draw, at the supersampled scale
    :param center: x, y in pixels of ``surface``
    :param radius: of the glyph with its halo, in pixels of ``surface``
    :param role: index of its role, None for a robot without one
    """
    pygame = load_pygame()
    sides = 0 if role is None else _ROLE_SIDES[role % len(_ROLE_SIDES)]
    halo = max(2.0, 0.14 * radius)
    for color, extent in (
        (INK, radius),
        (WHITE, radius - 1),
        (role_color(role), radius - 1 - halo),
    ):
        if sides == 0:
            pygame.draw.circle(surface, color, center, extent)
        elif sides == 4:
            # A square of the circle's extent would look larger than the circle.
            half = 0.9 * extent
            side = round(2 * half)
            box = (round(center[0] - side / 2), round(center[1] - side / 2), side, side)
            pygame.draw.rect(surface, color, box, border_radius=round(0.25 * half))
        else:
            corners = [
                (
                    center[0] + 1.15 * extent * math.sin(2 * math.pi * corner / sides),
                    center[1] - 1.15 * extent * math.cos(2 * math.pi * corner / sides),
                )
                for corner in range(sides)
            ]
            pygame.draw.polygon(surface, color, corners)


def target_tile(size: int, *, covered: bool, faded: bool = False) -> pygame.Surface:
    """Glyph of a target: a filled diamond when open, a small ring with a check when covered.

    :param size: side of the cell in final pixels
    :param covered: whether a robot has been on it
    :param faded: for a target that the team has not seen
    :return: a premultiplied surface (size, size) with transparent ground
    """
    pygame = load_pygame()
    scaled = size * SUPERSAMPLE
    tile = pygame.Surface((scaled, scaled), pygame.SRCALPHA, 32)
    middle = scaled / 2
    if covered:
        width = max(2, round(0.07 * scaled))
        pygame.draw.circle(tile, TARGET_COVERED, (middle, middle), 0.3 * scaled, width)
        if size >= 16:
            check = [(0.38, 0.51), (0.47, 0.60), (0.63, 0.41)]
            points = [(x * scaled, y * scaled) for x, y in check]
            pygame.draw.lines(tile, TARGET_COVERED, False, points, width)
    else:
        layers = ((TARGET_EDGE, 0.4), (TARGET_OPEN, 0.4 - max(2.4 / scaled, 0.06)))
        for color, half in ((HIDDEN_TARGET, 0.36),) if faded else layers:
            reach = half * scaled
            corners = [(0, -reach), (reach, 0), (0, reach), (-reach, 0)]
            pygame.draw.polygon(tile, color, [(middle + x, middle + y) for x, y in corners])
    return pygame.transform.smoothscale(tile, (size, size))


def frontier_tile(size: int) -> pygame.Surface:
    """Diagonal hatching of a frontier cell, which tells it from a free cell in gray.

    :param size: side of the cell in final pixels
    :return: a premultiplied surface (size, size) with transparent ground
    """
    pygame = load_pygame()
    scaled = size * SUPERSAMPLE
    tile = pygame.Surface((scaled, scaled), pygame.SRCALPHA, 32)
    # A whole number of stripes per cell lets the hatching run on from cell to cell.
    n_stripes = max(2, round(size / 6))
    for stripe in range(2 * n_stripes):
        start = round((stripe + 0.5) * scaled / n_stripes)
        pygame.draw.line(tile, FRONTIER_HATCH, (start, 0), (start - scaled, scaled), 2)
    return pygame.transform.smoothscale(tile, (size, size))


def draw_text(
    surface: pygame.Surface,
    text: str,
    size: int,
    color: Color,
    *,
    left: int | None = None,
    right: int | None = None,
    center_x: float | None = None,
    center_y: float,
) -> None:
    """Write one line of text in pygame's bundled font.

    :param surface: where to draw, at final scale
    :param text: what to write
    :param size: font size as ``pygame.font.Font`` takes it
    :param color: red, green, blue in 0..255
    :param left: x of its left end; give one of ``left``, ``right`` and ``center_x``
    :param right: x of its right end
    :param center_x: x of its middle
    :param center_y: y of the middle of its capitals and digits
    """
    ink, top, bottom, middle = _ink(text, size, color)
    if left is not None:
        x = float(left)
    elif right is not None:
        x = right - ink.get_width()
    else:
        x = (center_x or 0.0) - middle
    surface.blit(ink, (round(x), round(center_y - (top + bottom) / 2)))


# Text rather than fonts is kept between frames: fonts die with any ``pygame.quit()`` elsewhere.
@lru_cache(maxsize=512)
def _ink(text: str, size: int, color: Color) -> tuple[pygame.Surface, int, int, float]:
    """The text as a surface, top and bottom of its capitals, and the x of its visible middle."""
    font = load_pygame().font.Font(None, size)
    # The line box has more room above the capitals than below the baseline.
    capitals = font.render("H", True, color).get_bounding_rect()
    ink = font.render(text, True, color)
    visible = ink.get_bounding_rect()
    return ink, capitals.top, capitals.bottom, visible.left + visible.width / 2


@lru_cache(maxsize=256)
def fit_text(text: str, size: int, width: int) -> str:
    """Shorten ``text`` with an ellipsis until it fits.

    :param text: one line
    :param size: font size
    :param width: room in pixels
    :return: ``text``, or its beginning and an ellipsis
    """
    font = load_pygame().font.Font(None, size)
    if font.size(text)[0] <= width:
        return text
    while text and font.size(text + "...")[0] > width:
        text = text[:-1]
    return text.rstrip() + "..."
