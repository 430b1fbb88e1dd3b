"""Pictures of an episode: :func:`draw_frame` draws a ``Snapshot``, :class:`Window` shows frames."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from area_search import render_style as style
from area_search.render_map import draw_map
from area_search.render_panel import PANEL_WIDTH, draw_panel, panel_height
from area_search.snapshot import Snapshot

if TYPE_CHECKING:
    import pygame

_MARGIN = 14
_GAP = 22
_MAP_EXTENT = 600
_MIN_CELL_SIZE = 2


def default_cell_size(shape: tuple[int, int]) -> int:
    """Cell size at which the longer side of the map takes about 600 pixels.

    :param shape: rows and columns of the map
    :return: pixels, at least 2
    """
    return max(_MIN_CELL_SIZE, _MAP_EXTENT // max(shape))


def map_origin(snapshot: Snapshot, cell_size: int | None = None) -> tuple[int, int]:
    """Where the map begins in a frame, for who must find a cell in it.

    Cell (row, column) covers the pixels from ``y + row * cell_size`` and
    ``x + column * cell_size`` on.

    :param snapshot: what the frame shows
    :param cell_size: as given to :func:`draw_frame`
    :return: y and x of the upper left pixel of the map
    """
    cell = _checked_cell_size(snapshot, cell_size)
    spare = panel_height(snapshot) - len(snapshot.obstacle) * cell
    return _MARGIN + max(0, spare) // 2, _MARGIN


def draw_frame(
    snapshot: Snapshot, cell_size: int | None = None, *, hidden: bool = True
) -> np.ndarray:
    """Draw one frame; the same snapshot gives the same bytes. Needs no display.

    :param snapshot: what to show
    :param cell_size: side of a cell in pixels, at least 2; None chooses
        :func:`default_cell_size`. Ids, hatching and glyphs give way to plain color when cells
        are too small for them
    :param hidden: let true obstacles and open targets shine faintly through unexplored cells;
        otherwise these are opaque
    :return: uint8 (height, width, 3), red green blue; both sides even, as video encoders ask
    :raises ValueError: if ``cell_size`` is below 2
    """
    pygame = style.load_pygame()
    cell = _checked_cell_size(snapshot, cell_size)
    chart = draw_map(snapshot, cell, hidden=hidden)
    panel = draw_panel(snapshot, hidden=hidden)
    top, left = map_origin(snapshot, cell)

    width = left + chart.get_width() + _GAP + PANEL_WIDTH + _MARGIN
    height = 2 * _MARGIN + max(chart.get_height(), panel.get_height())
    frame = pygame.Surface((width + width % 2, height + height % 2), 0, 32)
    frame.fill(style.BACKGROUND)
    frame.fill(style.MUTED, chart.get_rect(topleft=(left, top)).inflate(2, 2))
    frame.blit(chart, (left, top))
    frame.blit(panel, (left + chart.get_width() + _GAP, _MARGIN))
    # Several times faster than surfarray, whose arrays are column by column.
    pixels = bytearray(pygame.image.tobytes(frame, "RGB"))
    return np.frombuffer(pixels, dtype=np.uint8).reshape(frame.get_height(), frame.get_width(), 3)


def _checked_cell_size(snapshot: Snapshot, cell_size: int | None) -> int:
    if cell_size is None:
        height, width = snapshot.obstacle.shape
        return default_cell_size((height, width))
    if cell_size < _MIN_CELL_SIZE:
        raise ValueError(f"cell_size must be at least {_MIN_CELL_SIZE} pixels, got {cell_size}")
    return cell_size


class Window:
    """A window on the screen that shows frames, for ``render_mode="human"``.

    It opens with the first frame and follows the size of the frames. pygame has one display per
    process, so that there should be one open window at a time.

    :param caption: text of the title bar
    """

    def __init__(self, caption: str = "area search") -> None:
        self.caption = caption
        self._screen: pygame.Surface | None = None
        self._clock: pygame.time.Clock | None = None
        self._closed = False

    @property
    def is_open(self) -> bool:
        """Whether the window is on the screen."""
        return self._screen is not None

    def show(self, frame: np.ndarray, fps: float) -> bool:
        """Show a frame, then wait as long as ``fps`` asks and answer the window's events.

        :param frame: uint8 (height, width, 3), as :func:`draw_frame` returns it
        :param fps: frames per second at most; 0 for no limit
        :return: False once the user has closed the window (its button, Escape or q) or
            :meth:`close` was called; further frames are then ignored
        :raises ValueError: if ``frame`` has another shape or dtype
        """
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(
                f"frame must be uint8 of shape (height, width, 3), got {frame.dtype} {frame.shape}"
            )
        if self._closed:
            return False
        pygame = style.load_pygame()
        size = (frame.shape[1], frame.shape[0])
        if self._screen is None or self._screen.get_size() != size:
            pygame.display.init()
            self._screen = pygame.display.set_mode(size)
            pygame.display.set_caption(self.caption)
            self._clock = pygame.time.Clock()
        pygame.surfarray.blit_array(self._screen, frame.swapaxes(0, 1))
        pygame.display.flip()
        for event in pygame.event.get():
            pressed = event.type == pygame.KEYDOWN and event.key in (pygame.K_ESCAPE, pygame.K_q)
            if event.type == pygame.QUIT or pressed:
                self.close()
                return False
        if self._clock is not None:
            self._clock.tick(fps)
        return True

    def close(self) -> None:
        """Take the window off the screen for good; closing twice does no harm."""
        if self._screen is not None:
            # Not pygame.quit(): other parts of the program may be using pygame.
            style.load_pygame().display.quit()
        self._screen = None
        self._clock = None
        self._closed = True
