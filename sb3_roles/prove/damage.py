"""Ways in which a file gets damaged: by disks, by programs that move it, by hands."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable

import numpy as np

from sb3_roles.common.stored_zip import pack

Damage = Callable[[np.random.Generator, bytes, bytes], bytes]
"""Of a generator, a sound file, and another sound one of the same kind; the damaged bytes."""
_PAGE = 4096


def members_of(file: bytes) -> dict[str, bytes]:
    """Return the members of a zip.

    :param file: its bytes
    """
    with zipfile.ZipFile(io.BytesIO(file)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def _at(rng: np.random.Generator, file: bytes, width: int = 1) -> int:
    return int(rng.integers(max(1, len(file) - width + 1)))


def _put(file: bytes, at: int, block: bytes) -> bytes:
    return file[:at] + block + file[at + len(block) :]


def _truncated(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    return file[: _at(rng, file)]


def _bits(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    flipped = bytearray(file)
    for _ in range(int(rng.integers(1, 9))):
        flipped[_at(rng, file)] ^= 1 << int(rng.integers(8))
    return bytes(flipped)


def _bit_beside_members(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    """Flip a bit that belongs to no member: dates, flags, sizes, the directory at the end."""
    with zipfile.ZipFile(io.BytesIO(file)) as archive:
        starts = [entry.header_offset for entry in archive.infolist()]
        end = archive.start_dir
    places = [at + i for at in starts for i in range(30)] + list(range(end, len(file)))
    at = int(rng.choice(places))
    return _put(file, at, bytes([file[at] ^ 1 << int(rng.integers(8))]))


def _lost_page(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    at = _at(rng, file) // _PAGE * _PAGE
    return _put(file, at, bytes(min(_PAGE, len(file) - at)))


def _two_places(rng: np.random.Generator, file: bytes) -> tuple[int, int, int]:
    width = int(rng.integers(16, 2048))
    first, second = sorted(_at(rng, file, 2 * width) for _ in range(2))
    return first, second + width, width


def _repeated_block(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    first, second, width = _two_places(rng, file)
    return _put(file, second, file[first : first + width])


def _swapped_blocks(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    first, second, width = _two_places(rng, file)
    moved = _put(file, second, file[first : first + width])
    return _put(moved, first, file[second : second + width])


def _missing_block(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    at = _at(rng, file)
    return file[:at] + file[at + int(rng.integers(1, 2048)) :]


def _block_of_another(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    at, width = _at(rng, file), int(rng.integers(16, 2048))
    return _put(file, at, other[at : at + width])


def _inserted(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    at = _at(rng, file)
    return file[:at] + rng.bytes(int(rng.integers(1, 64))) + file[at:]


def _appended(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    return file + rng.bytes(int(rng.integers(1, 64)))


def _prepended(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    return rng.bytes(int(rng.integers(1, 64))) + file


def _empty(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    return b""


def _joined(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    return other + file if rng.integers(2) else file + other


def _member_of_another(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    """Take a member of another file, in a zip that is sound."""
    mine, theirs = members_of(file), members_of(other)
    names = [name for name in mine if mine[name] != theirs.get(name)]
    name = str(rng.choice(names))
    return _like(file, {**mine, name: theirs[name]})


BYTES: dict[str, Damage] = {
    "truncated": _truncated,
    "bits flipped": _bits,
    "a bit beside the members": _bit_beside_members,
    "a lost page": _lost_page,
    "a repeated block": _repeated_block,
    "swapped blocks": _swapped_blocks,
    "a missing block": _missing_block,
    "a block of another file": _block_of_another,
    "bytes inserted": _inserted,
    "bytes appended": _appended,
    "bytes prepended": _prepended,
    "empty": _empty,
    "two files in one": _joined,
    "a member of another file": _member_of_another,
}
"""Those that any zip may meet."""


def _like(file: bytes, members: dict[str, bytes]) -> bytes:
    """Pack members as the file's program did."""
    if "manifest.json" in members:
        return b"".join(pack(members))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, data)
    return packed.getvalue()


def _edited_manifest(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    """Change a fact by hand, in a zip that is sound."""
    members = members_of(file)
    manifest = json.loads(members["manifest.json"])
    name = str(rng.choice([key for key in manifest if key not in ("format", "format_version")]))
    value = manifest[name]
    manifest[name] = value + 1 if isinstance(value, int) else [value]
    return _like(file, {**members, "manifest.json": json.dumps(manifest, indent=1).encode()})


def _edited_weight(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    """Change a byte of a member, in a zip that is sound."""
    members = members_of(file)
    name = str(rng.choice([name for name in members if name != "manifest.json"]))
    at = _at(rng, members[name])
    members[name] = _put(members[name], at, bytes([members[name][at] ^ 1 << int(rng.integers(8))]))
    return _like(file, members)


def _other_order(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    members = members_of(file)
    names = list(members)
    while names == list(members):
        rng.shuffle(names)
    return _like(file, {name: members[name] for name in names})


def _packed_again(rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    """Unpack and pack with another program: other dates, possibly compressed."""
    packed = io.BytesIO()
    method = zipfile.ZIP_DEFLATED if rng.integers(2) else zipfile.ZIP_STORED
    with zipfile.ZipFile(packed, "w", method) as archive:
        for name, data in members_of(file).items():
            archive.writestr(zipfile.ZipInfo(name, (2024, 2, 3, 4, 5, 6)), data, method)
    return packed.getvalue()


CHECKPOINTS: dict[str, Damage] = {
    **BYTES,
    "an edited manifest": _edited_manifest,
    "an edited member": _edited_weight,
    "members in another order": _other_order,
    "packed by another program": _packed_again,
}
"""Those of checkpoints."""


def damaged_bytes(damage: Damage, rng: np.random.Generator, file: bytes, other: bytes) -> bytes:
    """Damage a file, so that it is another one.

    :param damage: how
    :param rng: of the choices
    :param file: sound
    :param other: another sound one
    """
    while (result := damage(rng, file, other)) == file:
        pass
    return result
