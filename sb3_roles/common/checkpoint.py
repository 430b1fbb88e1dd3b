"""The checkpoint format: one file, written atomically, verified, and read without running code.

A checkpoint is an uncompressed zip of a ``manifest.json`` (format version, and size and sha256 of
every other member), tensors as safetensors, and a tree of plain values as JSON. Nothing in it is
ever unpickled, evaluated or decompressed, no size is trusted before it is checked, and there is no
byte that could change unnoticed.
"""

from __future__ import annotations

import errno
import hashlib
import json
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import IO, Any, TypeVar

import numpy as np
import safetensors.numpy
import safetensors.torch
import torch as th

from sb3_roles.common.checkpoint_reading import (
    ARRAYS,
    FORMAT,
    FORMAT_VERSION,
    MANIFEST,
    OPTIMIZER,
    POLICY,
    STATE,
    SUM,
    Check,
    open_checkpoint,
    read_manifest,
    sum_of,
    verify,
)
from sb3_roles.common.checkpoint_reading import Checkpoint as Checkpoint
from sb3_roles.common.checkpoint_reading import CheckpointError as CheckpointError
from sb3_roles.common.checkpoint_reading import read_checkpoint as read_checkpoint
from sb3_roles.common.files import remove_partial, replace_file
from sb3_roles.common.plain_tree import encode_tree
from sb3_roles.common.stored_zip import StoredZipError, pack

T = TypeVar("T")
SUFFIX = ".ckpt"
_NAME = re.compile(r"step_([0-9]{12})\.ckpt")


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
    :param state: see :func:`~sb3_roles.common.plain_tree.encode_tree`
    :raises CheckpointError: if something can not be stored, or reads back differently
    :raises OSError: if the disk refuses; the earlier file is intact then
    """
    arrays: dict[str, np.ndarray] = {}
    try:
        tree = encode_tree(dict(state or {}), arrays)
        facts = encode_tree(dict(manifest), {}, "manifest")
    except ValueError as error:
        raise CheckpointError(str(error)) from error
    members = {
        POLICY: safetensors.torch.save(_on_cpu(policy)),
        OPTIMIZER: safetensors.torch.save(_on_cpu(optimizer or {})),
        ARRAYS: safetensors.numpy.save(arrays),
        STATE: json.dumps(tree).encode(),
    }
    facts = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        **facts,
        "members": {
            name: {"bytes": len(data), SUM: hashlib.sha256(data).hexdigest()}
            for name, data in members.items()
        },
    }
    facts[SUM] = sum_of(facts)
    members = {MANIFEST: json.dumps(facts, indent=1).encode(), **members}

    def write(file: IO[bytes]) -> None:
        file.writelines(pack(members))

    def check(temporary: Path) -> None:
        with open_checkpoint(temporary) as (written, found):
            if read_manifest(path, written, found) != json.loads(members[MANIFEST]):
                raise CheckpointError(f"{path}: reads back differently from what was written")
            verify(path, written, found, facts)

    try:
        replace_file(path, write, check)
    except StoredZipError as error:
        raise CheckpointError(f"{path}: {error}") from error


def _on_cpu(tensors: Mapping[str, th.Tensor]) -> dict[str, th.Tensor]:
    # Clones: safetensors refuses tensors that share memory.
    return {
        name: tensor.detach().to("cpu", copy=True).contiguous() for name, tensor in tensors.items()
    }


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
        """Make the folder, and remove what killed writers left; for the owner of the run only.

        :raises OSError: if it can not be made, or is a link: a run folder may come from anybody,
            and must not choose where files are removed
        """
        if self.folder.is_symlink():
            raise OSError(errno.ELOOP, "is a symbolic link, not a folder", str(self.folder))
        self.folder.mkdir(parents=True, exist_ok=True)
        remove_partial(self.folder)

    def paths(self) -> list[Path]:
        """Return the files, oldest first."""
        return sorted(path for path in self.folder.glob("*") if _NAME.fullmatch(path.name))

    def save(self, env_steps: int, **content: Any) -> Path:
        """Write one more, and remove the oldest beyond ``keep``.

        Later ones are left alone and not counted: a run that went back before a damaged one would
        lose what it has just saved.

        :param env_steps: joint steps of the run so far
        :param content: see :func:`write_checkpoint`
        :return: the file
        """
        path = self.folder / f"step_{env_steps:012d}{SUFFIX}"
        write_checkpoint(path, **content)
        for old in [one for one in self.paths() if one <= path][: -self.keep]:
            old.unlink(missing_ok=True)
        return path

    def newest(
        self, check: Check | None = None, weights_only: bool = False
    ) -> tuple[Path, Checkpoint]:
        """Read the newest sound one; older ones are taken with a warning.

        :param check: see :func:`read_checkpoint`
        :param weights_only: see :func:`read_checkpoint`
        :raises CheckpointError: if there is none
        """
        return self.first(lambda path: read_checkpoint(path, check, weights_only))

    def first(self, read: Callable[[Path], T]) -> tuple[Path, T]:
        """Return the newest one that can be read; older ones are taken with a warning.

        :param read: reads a file
        :raises CheckpointError: if there is none; what is wrong with the newest is said
        """
        reason, paths = "", self.paths()
        for path in reversed(paths):
            try:
                found = read(path)
            except CheckpointError as error:
                said = str(error).removeprefix(f"{path}: ")
                reason = reason or f"{path}: {said}"
                continue
            if reason:
                warnings.warn(f"{reason}; going back to {path.name}", stacklevel=3)
            return path, found
        if len(paths) > 1:
            reason += f"; none of the {len(paths)} checkpoints can be taken"
        raise CheckpointError(reason or f"{self.folder}: no checkpoint")
