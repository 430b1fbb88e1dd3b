"""Files and run folders that mean harm, each made from a copy of a sound run folder."""

from __future__ import annotations

import hashlib
import io
import json
import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch as th

from sb3_roles.common.stored_zip import pack
from sb3_roles.prove.damage import members_of

MODULE = "hostile_module_of_a_run"
"""A module beside the run folders, which nobody names on a command line."""
Spoil = Callable[[Path], object]


class Payload:
    """Makes a file when it is unpickled: harmless, and seen.

    :param marker: the file
    """

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        """Tell pickle what to call."""
        return Path.touch, (self.marker,)


def _payload(run: Path) -> bytes:
    return pickle.dumps(Payload(marker_of(run)))


def marker_of(run: Path) -> Path:
    """Return the file that is there if code of a run folder ran.

    :param run: the folder
    """
    return run.with_name(f"{run.name}_ran")


def checkpoint_of(run: Path) -> Path:
    """Return the newest checkpoint of a run folder.

    :param run: the folder
    """
    return max((run / "checkpoints").glob("step_*"))


def _members(change: Callable[[dict[str, bytes]], object], sums: bool = True) -> Spoil:
    """Change members of a checkpoint, with sums that fit."""

    def spoil(run: Path) -> None:
        path = checkpoint_of(run)
        members = members_of(path.read_bytes())
        change(members)
        if sums:
            manifest = json.loads(members["manifest.json"])
            # Files of earlier releases do not vouch for their manifest.
            manifest.pop("sha256", None)
            manifest["members"] = {
                name: {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
                for name, data in members.items()
                if name != "manifest.json"
            }
            members["manifest.json"] = json.dumps(manifest).encode()
        path.write_bytes(b"".join(pack(members)))

    return spoil


def _header(text: str | bytes, data: bytes = b"", name: str = "policy.safetensors") -> Spoil:
    content = text.encode() if isinstance(text, str) else text
    whole = len(content).to_bytes(8, "little") + content + data
    return _members(lambda members: members.update({name: whole}))


def _tensor(shape: list[Any], end: int, dtype: str = "F32", data: bytes = b"") -> Spoil:
    entry = {"dtype": dtype, "shape": shape, "data_offsets": [0, end]}
    return _header(json.dumps({"x": entry}), data)


def _state(text: str) -> Spoil:
    return _members(lambda members: members.update({"state.json": text.encode()}))


def _fact(key: str, value: Any) -> Spoil:
    """Change one fact of the state."""

    def change(members: dict[str, bytes]) -> None:
        state = json.loads(members["state.json"])
        state[key] = value
        members["state.json"] = json.dumps(state).encode()

    return _members(change)


def _file(name: str | None, text: str | bytes | Callable[[Path], bytes]) -> Spoil:
    """Replace a file, the checkpoint if it has no name."""

    def spoil(run: Path) -> None:
        content = text(run) if callable(text) else text
        path = checkpoint_of(run) if name is None else run / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)

    return spoil


def _in_place(name: str | None, make: Callable[[Path], object]) -> Spoil:
    def spoil(run: Path) -> None:
        path = checkpoint_of(run) if name is None else run / name
        if path.is_dir():
            path.rename(path.with_name("moved"))
        path.unlink(missing_ok=True)
        make(path)

    return spoil


def _link(name: str | None, target: str) -> Spoil:
    return _in_place(name, lambda path: path.symlink_to(target))


def _config(line: str) -> Spoil:
    """Replace a key of the configuration."""

    def spoil(run: Path) -> None:
        path, key = run / "config.yml", line.partition(":")[0]
        old = path.read_text().splitlines()
        found = next((i for i, text in enumerate(old) if text.startswith(f"{key}:")), len(old))
        rest = old[found + 1 :]
        while rest and rest[0][:1] in (" ", "-"):
            rest = rest[1:]
        path.write_text("\n".join([*old[:found], line, *rest]) + "\n")

    return spoil


def _sparse(path: Path) -> None:
    with open(path, "wb") as file:
        file.truncate(100 << 30)


def _bomb(run: Path) -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members_of(checkpoint_of(run).read_bytes()).items():
            archive.writestr(name, bytes(128 << 20) if name == "policy.safetensors" else data)
    return packed.getvalue()


def _extra_member(run: Path) -> bytes:
    members = members_of(checkpoint_of(run).read_bytes())
    return b"".join(pack({**members, "../x.py": b"print()"}))


def _overlapping(run: Path) -> bytes:
    """Let the directory point to the same bytes for two members."""
    content = bytearray(checkpoint_of(run).read_bytes())
    first = content.index(b"PK\1\2")
    second = content.index(b"PK\1\2", first + 4)
    third = content.index(b"PK\1\2", second + 4)
    content[third + 42 : third + 46] = content[second + 42 : second + 46]
    return bytes(content)


def _torch_pickle(run: Path) -> bytes:
    saved = io.BytesIO()
    th.save({"policy": Payload(marker_of(run))}, saved)
    return saved.getvalue()


def sb3_zip(run: Path) -> bytes:
    """Return a zip as SB3's, whose data holds a payload.

    :param run: folder that it is for
    """
    import base64

    data = {"policy_class": {":type:": "x", ":serialized:": ""}}
    data["policy_class"][":serialized:"] = base64.b64encode(_payload(run)).decode()
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        archive.writestr("data", json.dumps(data))
        archive.writestr("_stable_baselines3_version", "2.9.2")
    return packed.getvalue()


def _laughs(levels: int = 60) -> str:
    lines = ["a0: &a0 [x, x]"]
    lines += [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}]" for i in range(1, levels)]
    return "\n".join(lines) + "\n"


def _merges(levels: int = 60) -> str:
    lines = ["a0: &a0 {x: 1}"]
    lines += [f"a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}]}}" for i in range(1, levels)]
    return "\n".join(lines) + "\n"


_TAGGED = "algo: !!python/object/apply:os.system ['touch hostile_tag_ran']\n"
_MANY_NAMES = json.dumps(
    {f"{i}": {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]} for i in range(100_000)}
)

LOADED: dict[str, Spoil] = {
    "a pickle in the place of the checkpoint": _file(None, _payload),
    "weights of torch.save in its place": _file(None, _torch_pickle),
    "a zip of SB3 in its place": _file(None, sb3_zip),
    "a pickle in the place of the weights": lambda run: _members(
        lambda members: members.update({"policy.safetensors": _payload(run)})
    )(run),
    "a member ../x.py": _file(None, _extra_member),
    "a zip bomb": _file(None, _bomb),
    "members that overlap": _file(None, _overlapping),
    "a header of 2^60 bytes": _members(
        lambda members: members.update({"policy.safetensors": (2**60).to_bytes(8, "little")})
    ),
    "a tensor of 2^62 bytes": _tensor([2**30, 2**30], 2**62),
    "a tensor of a negative side": _tensor([-4, -1], 16, data=bytes(16)),
    "a tensor of no side, and of 2^40": _tensor([0, 2**40, 2**40], 0),
    "a tensor of another type": _tensor([2], 16, "F64", bytes(16)),
    "a type that there is not": _tensor([2], 16, "__import__", bytes(16)),
    "sides that are texts": _tensor(["4"], 16, data=bytes(16)),
    "tensors that share bytes": _header(
        json.dumps(
            {k: {"dtype": "F32", "shape": [4], "data_offsets": [0, 16]} for k in ("x", "y")}
        ),
        bytes(16),
    ),
    "a name twice": _header('{"x": {}, "x": {}}'),
    "odd names": _header(
        '{"../../x\\u0000": {"dtype": "U8", "shape": [1], "data_offsets": [0, 1]}}', b"0"
    ),
    "100,000 empty tensors": _header(_MANY_NAMES),
    "weights of 256 MiB": _tensor([64 << 20], 256 << 20, data=bytes(256 << 20)),
    "a manifest nested 100,000 deep": _members(
        lambda members: members.update({"manifest.json": b"[" * 100_000}), sums=False
    ),
    "a manifest with a key twice": _members(
        lambda members: members.update({"manifest.json": b'{"a": 1, "a": 2}'}), sums=False
    ),
    "a manifest of a million digits": _members(
        lambda members: members.update({"manifest.json": b"9" * 10**6}), sums=False
    ),
    "a manifest that is no text": _members(
        lambda members: members.update({"manifest.json": b"\xff\xfe\0"}), sums=False
    ),
    "a pipe in the place of the checkpoint": _in_place(None, os.mkfifo),
    "a folder in its place": _in_place(None, Path.mkdir),
    "a link to an endless device": _link(None, "/dev/zero"),
    "a sparse file of 100 GiB": _in_place(None, _sparse),
    "YAML that calls os.system": _file("config.yml", _TAGGED),
    "YAML of 2^60 values by aliases": _file("config.yml", _laughs()),
    "YAML of 2^60 keys by merging": _file("config.yml", _merges()),
    "YAML that holds itself": _file("config.yml", "algo: &a [*a]\n"),
    "YAML nested 100,000 deep": _file("config.yml", "[" * 100_000),
    "YAML with a number of 100,000 digits": _config("seed: 0x" + "f" * 100_000),
    "a configuration that is a pipe": _in_place("config.yml", os.mkfifo),
    "a configuration without end": _link("config.yml", "/dev/zero"),
    "an environment os:system": _config("env: os:system"),
    "an environment of a module beside it": _config(f"env: {MODULE}:make"),
    "a policy of 20 GB": _config("policy_kwargs: {role_arch: [65536, 65536, 65536]}"),
}
"""Kinds that every way to load refuses."""
RESUMED: dict[str, Spoil] = {
    "a state nested 100,000 deep": _state("[" * 100_000),
    "a state with a number of a million digits": _state("9" * 10**6),
    "a state of ten million lists": _state("[" + "[]," * 10_000_000 + "[]]"),
    "a state of nothing": _state("{}"),
    "an array that is not there": _fact("last_episode_starts", {"__array__": "state/none"}),
    "an array of another place": _fact("last_episode_starts", {"__array__": "state/rng/torch"}),
    "counters that are no numbers": _fact("counters", {"num_timesteps": float("nan")}),
    "generators that are none": _fact("rng", {"torch": [], "cuda": [], "numpy": [], "python": []}),
    "callbacks that it has not": _fact("stateful", [["os.system", "true"]]),
    "an optimizer of other parameters": _header(
        '{"99.x": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}',
        bytes(4),
        "optimizer.safetensors",
    ),
    "arrays of 256 MiB": _header(
        json.dumps({"x": {"dtype": "U8", "shape": [1 << 28], "data_offsets": [0, 1 << 28]}}),
        bytes(1 << 28),
        "arrays.safetensors",
    ),
    "options that call os.system": _file("args.yml", _TAGGED),
    "options of 2^60 values": _file("args.yml", _laughs()),
    "options that are a pipe": _in_place("args.yml", os.mkfifo),
    "options that write elsewhere": _file("args.yml", "tensorboard_log: /nowhere/of/a/run\n"),
    "a log with a field of 8 MiB": _file("progress.csv", "a\n" + "x" * (8 << 20) + "\n"),
    "a log without end": _link("progress.csv", "/dev/zero"),
    "a log that is a pipe": _in_place("progress.csv", os.mkfifo),
    "a lock that is a link": _link("lock", "../elsewhere"),
    "a command that is a link": _link("command.txt", "../elsewhere"),
    "a folder of the best policy that is a link": _link("best", "../elsewhere"),
    "checkpoints that are a link": _in_place(
        "checkpoints", lambda path: path.symlink_to(path.with_name("moved"))
    ),
}
"""Kinds that only what goes on with a run reads."""
