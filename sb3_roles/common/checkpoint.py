"""The checkpoint format: one file, written atomically, verified, and read without running code.

A checkpoint is an uncompressed zip of a ``manifest.json`` (format version, and size and sha256 of
every other member), tensors as safetensors, and a tree of plain values as JSON. Nothing in it is
ever unpickled, evaluated or decompressed, and no size is trusted before it is checked.
"""

from __future__ import annotations

import hashlib
import json
import re
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import safetensors
import safetensors.numpy
import safetensors.torch
import torch as th

from sb3_roles.common.files import remove_partial, replace_file
from sb3_roles.common.names import one_line

FORMAT = "sb3_roles checkpoint"
FORMAT_VERSION = 1
SUFFIX = ".ckpt"
MANIFEST, STATE = "manifest.json", "state.json"
POLICY, OPTIMIZER, ARRAYS = "policy.safetensors", "optimizer.safetensors", "arrays.safetensors"
_MEMBERS = (MANIFEST, STATE, POLICY, OPTIMIZER, ARRAYS)
MAX_BYTES = 8 << 30
_MAX_JSON = 64 << 20
_NAME = re.compile(r"step_([0-9]{12})\.ckpt")
_EPOCH = (1980, 1, 1, 0, 0, 0)


class CheckpointError(ValueError):
    """A file that is no sound checkpoint, or does not fit; the message is a single line."""


@dataclass(frozen=True, eq=False)
class Checkpoint:
    """What a checkpoint file holds.

    :param manifest: facts about it, plain values
    :param policy: weights and buffers of the policy
    :param optimizer: its optimizer's tensors, ``<parameter's index>.<name>``
    :param state: everything else, plain values and numpy arrays; empty in a file of weights only
    """

    manifest: dict[str, Any]
    policy: dict[str, th.Tensor]
    optimizer: dict[str, th.Tensor]
    state: dict[str, Any]


# The state: a tree of plain values and arrays, as JSON and safetensors


def encode_tree(value: Any, arrays: dict[str, np.ndarray], where: str = "state") -> Any:
    """Turn a tree into JSON values, and collect its arrays.

    :param value: dicts with text keys, lists, tuples (which become lists), numbers, texts, None,
        numpy scalars and numpy arrays of numbers
    :param arrays: filled with the arrays, by their place
    :param where: name of this place
    :raises CheckpointError: naming the place of a value that can not be stored
    """
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise CheckpointError(f"{where} is an array of {value.dtype}, which can not be stored")
        arrays[where] = np.ascontiguousarray(value).reshape(value.shape)
        return {"__array__": where}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Mapping):
        wrong = [key for key in value if not isinstance(key, str) or key == "__array__"]
        if wrong:
            raise CheckpointError(f"{where} has the key {wrong[0]!r}: keys must be texts")
        return {key: encode_tree(item, arrays, f"{where}/{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [encode_tree(item, arrays, f"{where}/{i}") for i, item in enumerate(value)]
    raise CheckpointError(f"{where} is a {type(value).__name__}, which can not be stored")


def decode_tree(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Undo :func:`encode_tree`; tuples have become lists.

    :param value: JSON values
    :param arrays: by place
    """
    if isinstance(value, dict):
        if "__array__" in value:
            return arrays[value["__array__"]]
        return {key: decode_tree(item, arrays) for key, item in value.items()}
    if isinstance(value, list):
        return [decode_tree(item, arrays) for item in value]
    return value


# One file


def write_checkpoint(
    path: Path,
    manifest: Mapping[str, Any],
    policy: Mapping[str, th.Tensor],
    optimizer: Mapping[str, th.Tensor] | None = None,
    state: Mapping[str, Any] | None = None,
) -> None:
    """Write a checkpoint, so that a crash at any moment leaves the old file or the new one.

    :param path: the file
    :param manifest: facts to keep, plain values
    :param policy: weights and buffers
    :param optimizer: its tensors
    :param state: see :func:`encode_tree`
    :raises CheckpointError: if something can not be stored, or reads back differently
    :raises OSError: if the disk refuses; the earlier file is intact then
    """
    arrays: dict[str, np.ndarray] = {}
    tree = encode_tree(dict(state or {}), arrays)
    members = {
        POLICY: safetensors.torch.save(_on_cpu(policy)),
        OPTIMIZER: safetensors.torch.save(_on_cpu(optimizer or {})),
        ARRAYS: safetensors.numpy.save(arrays),
        STATE: json.dumps(tree).encode(),
    }
    facts = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **encode_tree(dict(manifest), {}, "manifest"),
        "members": {
            name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
            for name, data in members.items()
        },
    }
    members = {MANIFEST: json.dumps(facts, indent=1).encode(), **members}

    def write(file: IO[bytes]) -> None:
        with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
            for name, data in members.items():
                # A fixed date: equal states make equal files.
                archive.writestr(zipfile.ZipInfo(name, _EPOCH), data)

    def check(written: Path) -> None:
        if _read(written)[1] != {name: members[name] for name in members if name != MANIFEST}:
            raise CheckpointError(f"{path}: reads back differently from what was written")

    replace_file(path, write, check)


def _on_cpu(tensors: Mapping[str, th.Tensor]) -> dict[str, th.Tensor]:
    # Clones: safetensors refuses tensors that share memory.
    return {
        name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in tensors.items()
    }


def _read(path: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the manifest and the members that it vouches for."""
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise CheckpointError(f"{path}: {size} bytes, more than the {MAX_BYTES} of any checkpoint")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if sorted(entry.filename for entry in entries) != sorted(_MEMBERS):
            raise CheckpointError(f"{path}: its members are not those of a checkpoint")
        for entry in entries:
            stored = entry.compress_type == zipfile.ZIP_STORED
            if not stored or entry.file_size != entry.compress_size or entry.file_size > size:
                raise CheckpointError(f"{path}: {entry.filename} is not stored as it is")
            if entry.filename.endswith(".json") and entry.file_size > _MAX_JSON:
                raise CheckpointError(f"{path}: {entry.filename} has {entry.file_size} bytes")
        data = {name: archive.read(name) for name in _MEMBERS}
    manifest = json.loads(data.pop(MANIFEST))
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise CheckpointError(f"{path}: no checkpoint of sb3_roles")
    if manifest.get("format_version") != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: format version {manifest.get('format_version')!r}, this program reads "
            f"{FORMAT_VERSION}"
        )
    expected = {
        name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        for name, content in data.items()
    }
    if manifest.get("members") != expected:
        raise CheckpointError(f"{path}: a member is not what the manifest says")
    return manifest, data


def read_checkpoint(path: Path) -> Checkpoint:
    """Read a checkpoint and verify it. No code of the file runs, whatever it holds.

    :param path: the file
    :raises CheckpointError: if it is damaged, or none
    """
    try:
        manifest, members = _read(path)
        arrays = safetensors.numpy.load(members[ARRAYS])
        return Checkpoint(
            manifest,
            safetensors.torch.load(members[POLICY]),
            safetensors.torch.load(members[OPTIMIZER]),
            decode_tree(json.loads(members[STATE]), arrays),
        )
    except CheckpointError:
        raise
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror or error}") from error
    except (
        zipfile.BadZipFile,
        safetensors.SafetensorError,
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        EOFError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        message = one_line(error)
        raise CheckpointError(f"{path}: damaged checkpoint: {message}") from error


# A folder of them


class CheckpointFolder:
    """The last checkpoints of a run.

    :param folder: where they are; see :meth:`prepare`
    :param keep: how many are kept, at least 2, so that one is left when the newest is damaged
    :raises ValueError: if ``keep`` is below 2
    """

    def __init__(self, folder: Path, keep: int = 2) -> None:
        if keep < 2:
            raise ValueError(f"keep must be at least 2, got {keep}")
        self.folder, self.keep = folder, keep

    def prepare(self) -> None:
        """Make the folder, and remove what killed writers left; for the owner of the run only."""
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_partial(self.folder)

    def paths(self) -> list[Path]:
        """Return the files, oldest first."""
        return sorted(path for path in self.folder.glob("*") if _NAME.fullmatch(path.name))

    def save(self, env_steps: int, **content: Any) -> Path:
        """Write one more, and remove the oldest beyond ``keep``.

        :param env_steps: joint steps of the run so far
        :param content: see :func:`write_checkpoint`
        :return: the file
        """
        path = self.folder / f"step_{env_steps:012d}{SUFFIX}"
        write_checkpoint(path, **content)
        for old in self.paths()[: -self.keep]:
            old.unlink(missing_ok=True)
        return path

    def newest(self) -> tuple[Path, Checkpoint]:
        """Read the newest sound one; older ones are taken with a warning.

        :raises CheckpointError: if there is none
        """
        reason = ""
        for path in reversed(self.paths()):
            try:
                checkpoint = read_checkpoint(path)
            except CheckpointError as error:
                reason = reason or str(error)
                continue
            if reason:
                warnings.warn(f"{reason}; going back to {path.name}", stacklevel=2)
            return path, checkpoint
        raise CheckpointError(reason or f"{self.folder}: no checkpoint")
