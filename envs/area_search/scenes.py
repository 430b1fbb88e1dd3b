"""Scenes: every fact of the area-search task as one validated value, and the paper's scenes."""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from numbers import Integral, Real
from typing import Any

MIN_SIZE, MAX_SIZE = 5, 1024
MAX_AGENTS = 1024
MAX_SENSOR_RADIUS = 32
MAX_VIEW_RADIUS = 32
MAX_HORIZON = 1_000_000
REWARD_SHARING = ("own", "same_role")
# Fields that scenes did not always have, and what they were like before.
LATER = {"team_share": 0.0}
# What the teams of one batch have in common: the shapes of arrays, and who hears whom.
_SHARED = (
    "height",
    "width",
    "n_agents",
    "sensor_radius",
    "view_radius",
    "communication_radius",
    "horizon",
)


class SceneError(ValueError):
    """A scene, or an option of one, that cannot exist; the message is a single line."""


@dataclass(frozen=True)
class Scene:
    """One area-search task; Section V-A of the paper, with the facts it leaves out made explicit.

    Sizes, radii and distances are in cells, times in joint environment steps. A scene is immutable:
    use :meth:`with_options` to derive another one.

    :param name: label used in records, logs and run folders
    :param height: rows of the map
    :param width: columns of the map
    :param free_fraction: share of all cells that are free, in (0, 1]; the rest are obstacles
    :param n_targets: targets on distinct free cells
    :param n_agents: robots in the team
    :param spawn_sigma: standard deviation of the robots' start cells around the seed cell
    :param spawn_sigma_growth: added to ``spawn_sigma`` each time a start cell is an obstacle
    :param sensor_radius: Euclidean radius of the sensed disc, no occlusion
    :param view_radius: half-width of the egocentric ``local`` observation (4 gives 9 x 9)
    :param communication_radius: robots strictly nearer than this (Euclidean) can communicate
    :param horizon: steps until the episode is truncated
    :param early_stop_patience: the episode terminates once any robot has gone this many steps
        without covering a target; ``None`` never (evaluation); the authors train with 10
    :param explore_normalizer: B_e, newly explored cells that are worth a reward of 1; the paper's
        lens formula is misprinted, the released code uses 3, and 5 normalizes R_e into [0, 1]
    :param reward_sharing: ``"own"`` rewards a robot for its own cells and targets, ``"same_role"``
        for those of all robots that act in its role (Eq. 6); without roles that is the whole team
    :param team_share: s, with ``reward_sharing="own"``: a robot's reward, and each component of
        it, is (1 - s) of its own and s of the mean over the team
    :param alpha: weight of the exploration reward R_e in the scalar reward (Eq. 2)
    :param beta: weight of the coverage reward R_c in the scalar reward (Eq. 2)
    :raises SceneError: if a field is out of its range, or the targets do not fit
    """

    name: str = "hard"
    height: int = 25
    width: int = 25
    free_fraction: float = 0.6
    n_targets: int = 100
    n_agents: int = 4
    spawn_sigma: float = 1.0
    spawn_sigma_growth: float = 0.1
    sensor_radius: float = 2.0
    view_radius: int = 4
    communication_radius: float = 10.0
    horizon: int = 50
    early_stop_patience: int | None = None
    explore_normalizer: float = 3.0
    reward_sharing: str = "own"
    alpha: float = 0.4
    beta: float = 0.6
    team_share: float = 0.0

    def __post_init__(self) -> None:
        # It becomes part of file names.
        if not (isinstance(self.name, str) and re.fullmatch(r"[\w.-]+", self.name)):
            raise SceneError(
                "scene field name must be letters, digits, '_', '-' and '.', "
                f"got {shown(self.name)}"
            )
        for field, low, high in (
            ("height", MIN_SIZE, MAX_SIZE),
            ("width", MIN_SIZE, MAX_SIZE),
            ("n_agents", 1, MAX_AGENTS),
            ("view_radius", 1, MAX_VIEW_RADIUS),
            ("horizon", 1, MAX_HORIZON),
        ):
            self._check_integer(field, low, high)
        if self.early_stop_patience is not None:
            self._check_integer("early_stop_patience", 1, MAX_HORIZON, " or None")
        for field, bottom, top in (
            ("spawn_sigma", 0.0, 1e6),
            ("spawn_sigma_growth", 1e-6, 1e6),
            ("sensor_radius", 0.0, MAX_SENSOR_RADIUS),
            ("communication_radius", 0.0, 1e6),
            ("alpha", 0.0, 1e6),
            ("beta", 0.0, 1e6),
            ("team_share", 0.0, 1.0),
        ):
            self._check_number(field, bottom, top)
        self._check_number("free_fraction", 0.0, 1.0, open_low=True)
        self._check_number("explore_normalizer", 0.0, 1e6, open_low=True)
        self._check_integer("n_targets", 1, MAX_SIZE * MAX_SIZE)
        if self.n_targets > self.n_free:
            raise SceneError(
                f"scene field n_targets must be between 1 and the {self.n_free} free cells "
                f"({self.free_fraction:g} of {self.height} x {self.width}), got {self.n_targets}"
            )
        if not isinstance(self.reward_sharing, str) or self.reward_sharing not in REWARD_SHARING:
            raise SceneError(unknown("reward_sharing", self.reward_sharing, REWARD_SHARING))
        if self.team_share > 0.0 and self.reward_sharing != "own":
            raise SceneError(
                f"scene field team_share must be 0 with reward_sharing {self.reward_sharing!r}, "
                f"which shares already, got {self.team_share:g}"
            )

    def _check_integer(self, field: str, low: int, high: int, or_else: str = "") -> None:
        value = getattr(self, field)
        whole = isinstance(value, Integral) and not isinstance(value, bool)
        if not whole or not low <= value <= high:
            raise SceneError(
                f"scene field {field} must be a whole number from {low} to {high}{or_else}, "
                f"got {shown(value)}"
            )
        # A numpy number becomes a plain one: a scene is data, to be written as text.
        object.__setattr__(self, field, int(value))

    def _check_number(self, field: str, low: float, high: float, open_low: bool = False) -> None:
        value = getattr(self, field)
        valid = isinstance(value, Real) and not isinstance(value, bool)
        if not valid or not (low < value if open_low else low <= value) or not value <= high:
            bracket = "(" if open_low else "["
            raise SceneError(
                f"scene field {field} must be a number in {bracket}{low:g}, {high:g}], "
                f"got {shown(value)}"
            )
        object.__setattr__(self, field, float(value))

    @property
    def n_cells(self) -> int:
        """Cells of the map, obstacles included."""
        return self.height * self.width

    @property
    def n_free(self) -> int:
        """Free cells: carving goes on until their share is reached, so it rounds up."""
        # Rounding first keeps 0.1 + 0.2 style noise from adding a cell.
        return max(1, math.ceil(round(self.free_fraction * self.n_cells, 6)))

    @property
    def n_obstacles(self) -> int:
        """Obstacle cells."""
        return self.n_cells - self.n_free

    def facts(self) -> dict[str, Any]:
        """Return the fields by name, as records and recordings hold them.

        What scenes did not always have is left out where it is as it was, so that a scene has the
        same facts, and their hash, as before; ``Scene(**facts)`` is the scene.
        """
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        for name, before in LATER.items():
            if values[name] == before:
                del values[name]
        return values

    def with_options(self, **options: Any) -> Scene:
        """Return a copy with some fields changed.

        :param options: field names and values; ``None`` as ``early_stop_patience`` switches it off
        :return: the new, validated scene
        :raises SceneError: if a field does not exist or a value is out of range
        """
        known = [field.name for field in fields(self)]
        for key in options:
            if key not in known:
                raise SceneError(unknown("scene field", key, known))
        return replace(self, **options)


def shown(value: object) -> str:
    """Show any value on one short line, for error messages.

    :param value: anything
    """
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else f"{text[:57]}..."


def unknown(what: str, given: object, allowed: Any) -> str:
    """One line saying that a name is not known, what is allowed, and the closest match.

    :param what: the kind of thing that was named
    :param given: the name that was given
    :param allowed: the names that exist
    :return: the message
    """
    names = [str(name) for name in allowed]
    # Not of a long text: that search takes minutes.
    folded = {name.lower(): name for name in names}
    close = difflib.get_close_matches(str(given)[:100].lower(), folded, n=1)
    hint = f"; did you mean {folded[close[0]]!r}?" if close else ""
    return f"unknown {what} {shown(given)}: allowed are {', '.join(names)}{hint}"


# Targets are fractions of all 625 cells: 56, 24, 16 and 8 % (Tables I-III); the obstacles_* rows
# are Table IV, whose heading gives the free fractions (0.49 is the paper's "52 % obstacles").
SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene(name="easy", n_targets=350),
        Scene(name="medium", n_targets=150),
        Scene(name="hard", n_targets=100),
        Scene(name="super_hard", n_targets=50),
        Scene(name="obstacles_16", free_fraction=0.84),
        Scene(name="obstacles_40", free_fraction=0.6),
        Scene(name="obstacles_52", free_fraction=0.49),
    )
}


def get_scene(scene: str | Scene, **options: Any) -> Scene:
    """Look a scene up by name and change some of its fields.

    :param scene: a name of :data:`SCENES`, or a scene
    :param options: fields to change, see :meth:`Scene.with_options`
    :return: the scene
    :raises SceneError: if the name or a field is unknown, or a value is out of range
    """
    if isinstance(scene, str):
        if scene not in SCENES:
            raise SceneError(unknown("scene", scene, SCENES))
        scene = SCENES[scene]
    elif not isinstance(scene, Scene):
        raise SceneError(f"scene must be a name or a Scene, got {type(scene).__name__}")
    return scene.with_options(**options) if options else scene


def get_scenes(scenes: str | Scene | Sequence[str | Scene], **options: Any) -> tuple[Scene, ...]:
    """Look up the scenes of a batch: one, or a mix of several.

    :param scenes: what :func:`get_scene` takes, or a list of such; the scenes of a list must have
        different names, and the same map size, robots, sensor, view, communication and horizon
    :param options: fields to change in each of them
    :return: at least one
    :raises SceneError: if one is unknown or out of range, or they do not go together
    """
    if isinstance(scenes, (str, Scene)) or not isinstance(scenes, Sequence):
        return (get_scene(scenes, **options),)
    found = tuple(get_scene(scene, **options) for scene in scenes)
    if not found:
        raise SceneError("a mix of scenes must have at least one, got none")
    first, names = found[0], [scene.name for scene in found]
    for k, scene in enumerate(found):
        if scene.name in names[:k]:
            raise SceneError(f"a mix of scenes must have each of them once, got {scene.name} twice")
        for field in _SHARED:
            values = getattr(first, field), getattr(scene, field)
            if values[0] != values[1]:
                raise SceneError(
                    f"scenes of a mix must agree in {field}: it is {values[0]} in {first.name}, "
                    f"{values[1]} in {scene.name}"
                )
    return found


def mix_of(scenes: Sequence[Scene]) -> str:
    """Call several scenes what messages call them, with their names.

    :param scenes: of a mix
    """
    return f"a mix of scenes ({', '.join(scene.name for scene in scenes)})"


def only_scene(scenes: Sequence[Scene]) -> Scene:
    """Return what all teams play.

    :param scenes: of a batch
    :raises ValueError: if it is a mix
    """
    if len(scenes) > 1:
        raise ValueError(f"the teams play {mix_of(scenes)}, where one is needed")
    return scenes[0]
