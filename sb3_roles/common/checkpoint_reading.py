"""Reading of checkpoints: nothing runs, nothing is believed before it is checked."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Container, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import safetensors
import safetensors.numpy
import safetensors.torch
import torch as th

from sb3_roles.common.files import open_regular
from sb3_roles.common.names import one_line, shown
from sb3_roles.common.plain_tree import decode_tree, parse_json
from sb3_roles.common.stored_zip import (
    MAX_BYTES,
    Member,
    find_members,
    read_member,
    sha256_of,
)
from sb3_roles.common.tensor_outline import tensor_outline

FORMAT = "sb3_roles checkpoint"
FORMAT_VERSION = 1
MANIFEST, STATE = "manifest.json", "state.json"
POLICY, OPTIMIZER, ARRAYS = "policy.safetensors", "optimizer.safetensors", "arrays.safetensors"
MEMBERS = (MANIFEST, POLICY, OPTIMIZER, ARRAYS, STATE)
_MAX_JSON = {MANIFEST: 4 << 20, STATE: 64 << 20}
SUM = "sha256"


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


@dataclass(frozen=True, eq=False)
class Outline:
    """What a checkpoint file declares, before any of it is given memory.

    :param manifest: see :class:`Checkpoint`
    :param policy: see :class:`Checkpoint`; tensors without memory, of the device "meta"
    :param optimizer: the same of the optimizer
    :param array_bytes: size of the arrays of the state
    """

    manifest: dict[str, Any]
    policy: dict[str, th.Tensor]
    optimizer: dict[str, th.Tensor]
    array_bytes: int


Check = Callable[[Outline], object]
"""Raises :class:`CheckpointError` where a file is not what the configuration asks for."""


def sum_of(facts: Mapping[str, Any]) -> str:
    """Return the SHA-256 by which a manifest vouches for itself, as it does for the members.

    :param facts: all of the manifest
    """
    vouched = {key: value for key, value in facts.items() if key != SUM}
    return hashlib.sha256(json.dumps(vouched, sort_keys=True).encode()).hexdigest()


@contextmanager
def open_checkpoint(path: Path) -> Iterator[tuple[IO[bytes], dict[str, Member]]]:
    """Open a file and find its members.

    :param path: the file
    :return: the file and where its members are
    :raises CheckpointError: if it, or a member, is too large
    :raises OSError: if it can not be opened, or is none
    :raises StoredZipError: if it is no zip of these members
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        if size > MAX_BYTES:
            raise CheckpointError(
                f"{path}: {size} bytes, more than the {MAX_BYTES} of any checkpoint"
            )
        found = find_members(file, MEMBERS, size)
        for name, most in _MAX_JSON.items():
            if found[name].size > most:
                raise CheckpointError(f"{path}: {name} has {found[name].size} bytes")
        yield file, found


def read_manifest(path: Path, file: IO[bytes], found: Mapping[str, Member]) -> dict[str, Any]:
    """Read the manifest.

    :param path: for the message
    :param file: of :func:`open_checkpoint`
    :param found: of :func:`open_checkpoint`
    :raises CheckpointError: if it is of no checkpoint, or does not fit the members' sizes
    """
    manifest = parse_json(read_member(file, found[MANIFEST]))
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise CheckpointError(f"{path}: no checkpoint of sb3_roles")
    if manifest.get("format_version") != FORMAT_VERSION:
        raise CheckpointError(
            f"{path}: format version {shown(manifest.get('format_version'))}, this program reads "
            f"{FORMAT_VERSION}"
        )
    # Files of earlier releases do not vouch for their manifest.
    if manifest.get(SUM, sum_of(manifest)) != sum_of(manifest):
        raise CheckpointError(f"{path}: the manifest is not what was written")
    sizes = {name: one.size for name, one in found.items() if name != MANIFEST}
    if {name: one["bytes"] for name, one in manifest["members"].items()} != sizes:
        raise CheckpointError(f"{path}: a member has another size than the manifest says")
    return manifest


def verify(
    path: Path,
    file: IO[bytes],
    found: Mapping[str, Member],
    manifest: Mapping[str, Any],
    leave_out: Container[str] = (),
) -> None:
    """Compare the members with the sums of the manifest, without holding them.

    :param path: for the message
    :param file: of :func:`open_checkpoint`
    :param found: of :func:`open_checkpoint`
    :param manifest: of :func:`read_manifest`
    :param leave_out: members that are not looked at
    :raises CheckpointError: if one is another
    """
    for name in MEMBERS:
        if name != MANIFEST and name not in leave_out:
            _compare(path, found[name], sha256_of(file, found[name]), manifest)


def _compare(path: Path, member: Member, digest: str, manifest: Mapping[str, Any]) -> None:
    if manifest["members"][member.name] != {"bytes": member.size, SUM: digest}:
        raise CheckpointError(f"{path}: {member.name} is not what the manifest says")


def read_checkpoint(
    path: Path, check: Check | None = None, weights_only: bool = False
) -> Checkpoint:
    """Read a checkpoint and verify it. No code of the file runs, whatever it holds.

    :param path: the file
    :param check: looks at what the file declares, before that is given memory
    :param weights_only: leave optimizer and state out; they are verified, but take no memory
    :raises CheckpointError: if it is damaged, or none, or refused by ``check``
    """
    with _refusing(path), open_checkpoint(path) as (file, found):
        manifest = read_manifest(path, file, found)
        if check is not None:
            check(_outline(manifest, file, found))

        def take(name: str) -> bytes:
            data = read_member(file, found[name])
            _compare(path, found[name], hashlib.sha256(data).hexdigest(), manifest)
            return data

        if weights_only:
            verify(path, file, found, manifest, leave_out=(POLICY,))
            return Checkpoint(manifest, safetensors.torch.load(take(POLICY)), {}, {})
        return Checkpoint(
            manifest,
            safetensors.torch.load(take(POLICY)),
            safetensors.torch.load(take(OPTIMIZER)),
            decode_tree(parse_json(take(STATE)), safetensors.numpy.load(take(ARRAYS))),
        )


def read_outline(path: Path) -> Outline:
    """Read what a file declares. Its tensors are neither read nor verified.

    :param path: the file
    :raises CheckpointError: if it is damaged as far as that is seen, or no checkpoint
    """
    with _refusing(path), open_checkpoint(path) as (file, found):
        return _outline(read_manifest(path, file, found), file, found)


def _outline(manifest: dict[str, Any], file: IO[bytes], found: Mapping[str, Member]) -> Outline:
    policy, optimizer = (tensor_outline(file, found[name]) for name in (POLICY, OPTIMIZER))
    tensor_outline(file, found[ARRAYS])
    return Outline(manifest, policy, optimizer, found[ARRAYS].size)


@contextmanager
def _refusing(path: Path) -> Iterator[None]:
    """Turn all ways of a file to be wrong into one line."""
    try:
        yield
    except CheckpointError:
        raise
    except OSError as error:
        raise CheckpointError(f"{path}: {error.strerror or error}") from error
    except (
        safetensors.SafetensorError,
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        OverflowError,
        RuntimeError,
    ) as error:
        raise CheckpointError(f"{path}: damaged checkpoint: {one_line(error)}") from error
