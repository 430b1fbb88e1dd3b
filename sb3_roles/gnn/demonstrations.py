"""Files of demonstrations: what a team knew at each step, and what its controller did."""

from __future__ import annotations

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from area_search.cells import JOINT_CHANNELS, KNOWN_CHANNELS, N_ACTIONS
from area_search.kernels import METRICS
from sb3_roles.common.files import open_regular, write_atomically
from sb3_roles.common.names import one_line
from sb3_roles.common.policies import POSITION_KEY
from sb3_roles.common.team_wrapper import AGENT_KEY

FORMAT, FORMAT_VERSION = "sb3_roles demonstrations", 1
# Maps of a step: the channels of `known`, and then those of `joint`.
MAPS = (*KNOWN_CHANNELS, *JOINT_CHANNELS)
MAX_BYTES = 4 << 30
_FACTS = "facts"
# Type and number of dimensions of each array.
_ARRAYS: dict[str, tuple[type, int]] = {
    _FACTS: (np.uint8, 1),
    "episodes": (np.int64, 1),
    "maps": (np.uint8, 4),
    "positions": (np.int16, 4),
    "actions": (np.int8, 3),
    "metrics": (np.float64, 2),
}


class DemonstrationError(ValueError):
    """A file that holds no demonstrations, or others than were asked for; a single line."""


@dataclass(frozen=True, eq=False)
class Demonstrations:
    """E episodes of T steps of a team of N robots, on maps of H x W cells.

    :param facts: ``controller``, ``seed``, ``scene`` (its fields by name) and whatever else is
        known of the recording; plain values
    :param episodes: int64 (E,), number of each episode in the stream of the seed
    :param maps: uint8 (E, T, 4, ceil(H W / 8)), bits of ``MAPS`` before each step
    :param positions: int16 (E, T, N, 2), row and column of each robot before each step
    :param actions: int8 (E, T, N); a move that was blocked is a stop
    :param metrics: float64 (E, 3), ``METRICS`` at the end of each episode, fractions
    """

    facts: Mapping[str, Any]
    episodes: np.ndarray
    maps: np.ndarray
    positions: np.ndarray
    actions: np.ndarray
    metrics: np.ndarray

    def __len__(self) -> int:
        return len(self.episodes)

    @property
    def n_steps(self) -> int:
        """Steps of an episode."""
        return self.actions.shape[1]

    @property
    def n_agents(self) -> int:
        """Robots of the team."""
        return self.actions.shape[2]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of the maps."""
        scene = self.facts["scene"]
        return int(scene["height"]), int(scene["width"])

    def first(self, n_episodes: int) -> Demonstrations:
        """Return the first episodes only.

        :param n_episodes: how many
        :raises DemonstrationError: if there are fewer
        """
        if n_episodes > len(self):
            raise DemonstrationError(
                f"there are {len(self)} demonstrated episodes, {n_episodes} are asked for: record "
                "more of them, or lower n_demonstrations"
            )
        return Demonstrations(
            self.facts, *(getattr(self, name)[:n_episodes] for name in _ARRAYS if name != _FACTS)
        )

    def observe(self, episodes: np.ndarray, steps: np.ndarray) -> dict[str, np.ndarray]:
        """Return what the teams observed at some steps, as area search says it.

        :param episodes: int64 (b,), rows of the arrays
        :param steps: int64 (b,)
        :return: ``known`` and ``joint`` uint8 (b, 2, H, W), ``position`` float32 (b N, 2) and
            ``agent`` float32 (b N, 2)
        """
        height, width = self.size
        bits = np.unpackbits(self.maps[episodes, steps], axis=-1, count=height * width)
        maps = bits.reshape(-1, len(MAPS), height, width)
        n = self.n_agents
        members = np.stack([np.arange(n), np.full(n, n)], axis=1).astype(np.float32)
        return {
            "known": maps[:, : len(KNOWN_CHANNELS)],
            "joint": maps[:, len(KNOWN_CHANNELS) :],
            POSITION_KEY: self.positions[episodes, steps].reshape(-1, 2).astype(np.float32),
            AGENT_KEY: np.tile(members, (len(maps), 1)),
        }

    def digest(self) -> str:
        """Return the SHA-256 of what was recorded.

        It depends on arrays and facts, but neither on how a file packs them nor on the version of
        this program: a recording that was made again or went on has the same for its first
        episodes.
        """
        facts = {key: value for key, value in self.facts.items() if key != "version"}
        content = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
        for name in _ARRAYS:
            if name != _FACTS:
                array = np.ascontiguousarray(getattr(self, name))
                content.update(f"{name} {array.shape}".encode())
                content.update(array.astype(array.dtype.newbyteorder("<")).data)
        return content.hexdigest()

    def save(self, path: Path) -> None:
        """Write a file, so that a crash at any moment leaves the old one or the new one.

        :param path: the file
        """
        facts = {"format": FORMAT, "format_version": FORMAT_VERSION, **self.facts}
        content = {_FACTS: np.frombuffer(json.dumps(facts).encode(), np.uint8)}
        content |= {name: getattr(self, name) for name in _ARRAYS if name != _FACTS}
        file = io.BytesIO()
        np.savez_compressed(file, **content)  # type: ignore[arg-type]
        write_atomically(path, file.getvalue())


def pack_maps(known: np.ndarray, joint: np.ndarray) -> np.ndarray:
    """Pack the maps of some teams, see ``Demonstrations.maps``.

    :param known: uint8 (n_teams, 2, H, W)
    :param joint: uint8 (n_teams, 2, H, W)
    :return: uint8 (n_teams, 4, ceil(H W / 8))
    """
    maps = np.concatenate([known, joint], axis=1)
    return np.packbits(maps.reshape(*maps.shape[:2], -1), axis=-1)


def load_demonstrations(path: str | Path) -> Demonstrations:
    """Read a file and check it. No code of the file runs, whatever it holds.

    :param path: the file
    :raises DemonstrationError: if it can not be read, or is no file of demonstrations
    """
    try:
        arrays = _read(Path(path))
        facts = json.loads(bytes(arrays.pop(_FACTS)))
        if not isinstance(facts, dict) or facts.pop("format", None) != FORMAT:
            raise DemonstrationError(f"{path}: no demonstrations of sb3_roles")
        version = facts.pop("format_version", None)
        if version != FORMAT_VERSION:
            raise DemonstrationError(
                f"{path}: format version {version!r}, this program reads {FORMAT_VERSION}"
            )
        found = Demonstrations(facts, **arrays)
        problem = _problem(found)
    except DemonstrationError:
        raise
    except OSError as error:
        raise DemonstrationError(f"{path}: {error.strerror or error}") from error
    except (
        zipfile.BadZipFile,
        ValueError,
        OverflowError,
        KeyError,
        TypeError,
        EOFError,
        NotImplementedError,
        RuntimeError,
        zipfile.zlib.error,  # type: ignore[attr-defined]
    ) as error:
        message = f"{path}: damaged demonstrations: {one_line(error)}"
        raise DemonstrationError(message) from error
    if problem is not None:
        raise DemonstrationError(f"{path}: damaged demonstrations: {problem}")
    return found


def _read(path: Path) -> dict[str, np.ndarray]:
    with open_regular(path) as file:
        return _read_open(path, file)


def _read_open(path: Path, opened: IO[bytes]) -> dict[str, np.ndarray]:
    with zipfile.ZipFile(opened) as archive:
        entries = archive.infolist()
        if sorted(entry.filename for entry in entries) != sorted(f"{k}.npy" for k in _ARRAYS):
            raise DemonstrationError(f"{path}: no demonstrations of sb3_roles")
        if sum(entry.file_size for entry in entries) > MAX_BYTES:
            raise DemonstrationError(f"{path}: more than {MAX_BYTES} bytes when unpacked")
        for entry in entries:
            # What this program writes; others fail with errors of their own libraries.
            if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
                raise DemonstrationError(f"{path}: {entry.filename} is not packed by numpy")
            with archive.open(entry) as file:
                problem = _header_problem(file, entry)
            if problem is not None:
                raise DemonstrationError(f"{path}: damaged demonstrations: {problem}")
    opened.seek(0)
    with np.load(opened, allow_pickle=False) as content:
        return {name: content[name] for name in _ARRAYS}


def _header_problem(file: IO[bytes], entry: zipfile.ZipInfo) -> str | None:
    """Say what is wrong with the head of an array, before memory is given to what it declares."""
    name = entry.filename.removesuffix(".npy")
    dtype, n_dimensions = _ARRAYS[name]
    if np.lib.format.read_magic(file) != (1, 0):
        return f"{name} has another version of numpy's format"
    shape, _, found = np.lib.format.read_array_header_1_0(file)
    if found != dtype or len(shape) != n_dimensions:
        return f"{name} is {found} of shape {shape}"
    expected, there = math.prod(shape) * found.itemsize, entry.file_size - file.tell()
    if expected != there:
        return f"{name} declares {expected} bytes, and has {there}"
    return None


def _problem(found: Demonstrations) -> str | None:
    """Say what does not fit together."""
    controller, scene = found.facts["controller"], found.facts["scene"]
    if not isinstance(controller, str) or not controller.isprintable():
        return f"the controller is {controller!r}"
    for key in ("height", "width"):
        side = scene[key]
        if isinstance(side, bool) or not isinstance(side, int) or side < 1:
            return f"the scene's {key} must be a whole number of at least 1, got {side!r}"
    (height, width), n = found.size, len(found)
    length, n_agents = found.actions.shape[1:]
    shapes = {
        "maps": (n, length, len(MAPS), -(-height * width // 8)),
        "positions": (n, length, n_agents, 2),
        "actions": (n, length, n_agents),
        "metrics": (n, len(METRICS)),
    }
    for name, shape in shapes.items():
        if getattr(found, name).shape != shape:
            return f"{name} have shape {getattr(found, name).shape}, expected {shape}"
    if not found.actions.size:
        return "there are no steps"
    if found.actions.min() < 0 or found.actions.max() >= N_ACTIONS:
        return f"actions must be in 0..{N_ACTIONS - 1}"
    if found.positions.min() < 0 or (found.positions >= (height, width)).any():
        return "a position is not on the map"
    return None
