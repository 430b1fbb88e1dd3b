"""Pictures of an episode: :class:`Snapshot` says what to show, :func:`draw_frame` draws it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from area_search import render_style as style
from area_search.render_map import draw_map
from area_search.render_panel import PANEL_WIDTH, draw_panel, panel_height

if TYPE_CHECKING:
    import pygame

_MARGIN = 14
_GAP = 22
_MAP_EXTENT = 600
_MIN_CELL_SIZE = 2


# Without eq=False the generated comparison would ask for the truth value of whole arrays.
@dataclass(frozen=True, eq=False, kw_only=True)
class Snapshot:
    """Everything that one frame shows of one team.

    H and W are the rows and columns of the map, N is the number of robots.

    :param obstacle: bool (H, W), the true obstacles
    :param explored: bool (H, W), the cells that the team has sensed
    :param frontier: bool (H, W), explored free cells next to an unexplored cell
    :param target_open: bool (H, W), every target not yet covered, seen or not
    :param target_covered: bool (H, W)
    :param position: int (N, 2), row and column of each robot; N >= 1
    :param roles: int (N,), indices into ``role_names``; None for robots without roles
    :param role_names: names of the roles
    :param path: int (T, N, 2), earlier positions, the latest last; None to draw no paths
    :param step: steps taken so far
    :param horizon: steps of a whole episode
    :param metrics: fractions by name, shown as percentages in this order; NaN shows as a dash
    :param sensor_radius: Euclidean, in cells
    :param view_radius: half-width of the observation window, in cells
    :param communication_radius: Euclidean, in cells; robots strictly nearer are linked
    :param title: first line of the side panel

    :raises ValueError: if an array has the wrong shape or dtype, or an entry is out of range
    """

    obstacle: np.ndarray
    explored: np.ndarray
    frontier: np.ndarray
    target_open: np.ndarray
    target_covered: np.ndarray
    position: np.ndarray
    step: int
    horizon: int
    metrics: Mapping[str, float]
    sensor_radius: float
    view_radius: int
    communication_radius: float
    roles: np.ndarray | None = None
    role_names: tuple[str, ...] = ("explore", "cover")
    path: np.ndarray | None = None
    title: str = ""

    def __post_init__(self) -> None:
        shape = self.obstacle.shape
        if len(shape) != 2 or 0 in shape:
            raise ValueError(f"obstacle must have shape (H, W) with H, W >= 1, got {shape}")
        for name in ("obstacle", "explored", "frontier", "target_open", "target_covered"):
            _check_array(name, getattr(self, name), shape, "bool")
        n_agents = len(self.position)
        if n_agents < 1:
            raise ValueError("position must hold at least one robot, got none")
        _check_array("position", self.position, (n_agents, 2), "integer")
        if np.any(self.position < 0) or np.any(self.position >= shape):
            raise ValueError(f"position must lie on the map of shape {shape} (row, column)")
        if self.roles is not None:
            _check_array("roles", self.roles, (n_agents,), "integer")
            if np.any(self.roles < 0) or np.any(self.roles >= len(self.role_names)):
                raise ValueError(
                    f"roles must be indices into role_names {self.role_names}, "
                    f"got {self.roles.tolist()}"
                )
        if self.path is not None:
            _check_array("path", self.path, (len(self.path), n_agents, 2), "integer")


def _check_array(name: str, array: np.ndarray, shape: tuple[int, ...], dtype: str) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    if not np.issubdtype(array.dtype, np.bool_ if dtype == "bool" else np.integer):
        raise ValueError(f"{name} must have dtype {dtype}, got {array.dtype}")


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
