"""Zip files of members that are stored as they are, every byte of which means something.

There is one way to write given members, and a file in which any byte differs from that way is
refused: no comments, no other dates, no members that overlap, nothing before, behind or between
them. Other programs open such a file as any zip.
"""

from __future__ import annotations

import hashlib
import struct
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import IO

MAX_BYTES = (2 << 30) - 1
"""Of a file: beyond, a zip needs extensions."""
# Signature, version, flags, method, time, date (1980-01-01), crc, size twice, lengths.
_LOCAL = struct.Struct("<4s5H3L2H")
_CENTRAL = struct.Struct("<4s6H3L5H2L")
_END = struct.Struct("<4s4H2LH")
_VERSION, _UNIX, _DATE, _MODE = 20, 3, 33, 0o600
_CHUNK = 1 << 20


class StoredZipError(ValueError):
    """A file that is no such zip; the message is a single line."""


@dataclass(frozen=True)
class Member:
    """Where a member of a file is.

    :param name: its name
    :param start: of its bytes in the file
    :param size: number of bytes
    :param crc: CRC-32 that the file claims
    """

    name: str
    start: int
    size: int
    crc: int


def _head(name: str, size: int, crc: int) -> bytes:
    fields = (b"PK\3\4", _VERSION, 0, 0, 0, _DATE, crc, size, size, len(name), 0)
    return _LOCAL.pack(*fields) + name.encode("ascii")


def _directory(members: Sequence[Member]) -> bytes:
    entries, start = b"", 0
    for one in members:
        name = one.name.encode("ascii")
        made_by = _UNIX << 8 | _VERSION
        sizes = (one.crc, one.size, one.size, len(name), 0, 0, 0, 0, _MODE << 16, start)
        entries += _CENTRAL.pack(b"PK\1\2", made_by, _VERSION, 0, 0, 0, _DATE, *sizes) + name
        start = one.start + one.size
    n = len(members)
    return entries + _END.pack(b"PK\5\6", 0, 0, n, n, len(entries), start, 0)


def pack(members: Mapping[str, bytes]) -> Iterator[bytes]:
    """Return the bytes of a file, in pieces.

    :param members: ASCII names -> bytes, in the order of the file
    :raises StoredZipError: if they are too large for one
    """
    if sum(map(len, members.values())) > MAX_BYTES - (1 << 16):
        raise StoredZipError(f"more than the {MAX_BYTES} bytes of a file")
    placed, at = [], 0
    for name, data in members.items():
        head = _head(name, len(data), zlib.crc32(data))
        yield head
        yield data
        placed.append(Member(name, at + len(head), len(data), zlib.crc32(data)))
        at += len(head) + len(data)
    yield _directory(placed)


def find_members(file: IO[bytes], names: Sequence[str], size: int) -> dict[str, Member]:
    """Find the members of a file, and check all that is not theirs; theirs is not read yet.

    :param file: open, at any place
    :param names: of the members, in the order of the file
    :param size: of the file
    :raises StoredZipError: if there is one byte that :func:`pack` would not have written
    """
    found, at = {}, 0
    for name in names:
        file.seek(at)
        head = file.read(_LOCAL.size + len(name))
        if len(head) < _LOCAL.size + len(name):
            raise StoredZipError(f"it ends before {name}")
        crc, length = _LOCAL.unpack_from(head)[6:8]
        if head != _head(name, length, crc):
            raise StoredZipError(f"no {name} at byte {at}, stored as it is")
        if length > size - at:
            raise StoredZipError(f"{name} is said to have {length} bytes, more than the file")
        found[name] = Member(name, at + len(head), length, crc)
        at += len(head) + length
    directory = _directory(list(found.values()))
    file.seek(at)
    if file.read(len(directory) + 1) != directory:
        raise StoredZipError("its directory of members is another one")
    return found


def chunks(file: IO[bytes], member: Member) -> Iterator[bytes]:
    """Read a member in pieces.

    :param file: open
    :param member: of :func:`find_members`
    :raises StoredZipError: at the end, if its CRC-32 is another one
    """
    file.seek(member.start)
    left, crc = member.size, 0
    while left:
        data = file.read(min(_CHUNK, left))
        if not data:
            raise StoredZipError(f"{member.name} ends too early")
        left, crc = left - len(data), zlib.crc32(data, crc)
        yield data
    if crc != member.crc:
        raise StoredZipError(f"{member.name} is damaged")


def read_member(file: IO[bytes], member: Member) -> bytes:
    """Read a member.

    :param file: open
    :param member: of :func:`find_members`
    :raises StoredZipError: if its CRC-32 is another one
    """
    return b"".join(chunks(file, member))


def sha256_of(file: IO[bytes], member: Member) -> str:
    """Return the SHA-256 of a member without holding all of it.

    :param file: open
    :param member: of :func:`find_members`
    :raises StoredZipError: if its CRC-32 is another one
    """
    digest = hashlib.sha256()
    for data in chunks(file, member):
        digest.update(data)
    return digest.hexdigest()
