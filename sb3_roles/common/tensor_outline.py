"""What a safetensors file declares, read before any of its tensors is given memory."""

from __future__ import annotations

import math
from typing import IO, Any

import torch as th

from sb3_roles.common.plain_tree import parse_json
from sb3_roles.common.stored_zip import Member

_MAX_HEADER = 16 << 20
_MAX_SIDE, _MAX_DIMENSIONS = 1 << 40, 16
_DTYPES = {
    "BOOL": th.bool,
    "U8": th.uint8,
    "I8": th.int8,
    "U16": th.uint16,
    "I16": th.int16,
    "F16": th.float16,
    "BF16": th.bfloat16,
    "U32": th.uint32,
    "I32": th.int32,
    "F32": th.float32,
    "U64": th.uint64,
    "I64": th.int64,
    "F64": th.float64,
}


def tensor_outline(file: IO[bytes], member: Member) -> dict[str, th.Tensor]:
    """Return the tensors of a member as tensors without memory, of the device "meta".

    :param file: open
    :param member: a safetensors file
    :raises ValueError: if its header is none, or does not account for every byte once
    """
    file.seek(member.start)
    length = int.from_bytes(file.read(min(8, member.size)), "little")
    if length > min(_MAX_HEADER, member.size - 8):
        raise ValueError(f"{member.name} declares a header of {length} bytes")
    header = parse_json(file.read(length))
    if not isinstance(header, dict):
        raise ValueError(f"{member.name} has no header")
    found: dict[str, th.Tensor] = {}
    spans = []
    for name, entry in header.items():
        dtype, shape, span = _entry(f"{member.name}: {name[:80]!r}", entry)
        found[name] = th.empty(shape, dtype=dtype, device="meta")
        spans.append(span)
    at = 0
    for begin, end in sorted(spans):
        if begin != at:
            raise ValueError(f"{member.name}: tensors overlap, or leave a gap, at byte {at}")
        at = end
    if at != member.size - 8 - length:
        raise ValueError(f"{member.name}: its tensors have {at} bytes, not those of the file")
    return found


def _entry(what: str, entry: Any) -> tuple[th.dtype, tuple[int, ...], tuple[int, int]]:
    if not isinstance(entry, dict) or sorted(entry) != ["data_offsets", "dtype", "shape"]:
        raise ValueError(f"{what} is no tensor")
    name, shape, span = entry["dtype"], entry["shape"], entry["data_offsets"]
    if not isinstance(name, str) or name not in _DTYPES:
        raise ValueError(f"{what} has the type {str(name)[:80]}")
    for whole, most in ((shape, _MAX_DIMENSIONS), (span, 2)):
        if (
            not isinstance(whole, list)
            or len(whole) > most
            or not all(type(one) is int and 0 <= one <= _MAX_SIDE for one in whole)
        ):
            raise ValueError(f"{what} has a shape or place that no tensor has")
    size = math.prod(shape) * _DTYPES[name].itemsize
    if len(span) != 2 or span[1] - span[0] != size:
        raise ValueError(f"{what} declares {size} bytes in another number of them")
    return _DTYPES[name], tuple(shape), (span[0], span[1])
