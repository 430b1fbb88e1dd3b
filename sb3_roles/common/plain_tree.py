"""Trees of plain values and arrays, as JSON and a flat list of arrays."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

_MAX_VALUES = 2_000_000
_MAX_DIGITS = 400


def encode_tree(value: Any, arrays: dict[str, np.ndarray], where: str = "state") -> Any:
    """Turn a tree into JSON values, and collect its arrays.

    :param value: dicts with text keys, lists, tuples (which become lists), numbers, texts, None,
        numpy scalars and numpy arrays of numbers
    :param arrays: filled with the arrays, by their place
    :param where: name of this place
    :raises ValueError: naming the place of a value that can not be stored
    """
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biuf":
            raise ValueError(f"{where} is an array of {value.dtype}, which can not be stored")
        arrays[where] = np.ascontiguousarray(value).reshape(value.shape)
        return {"__array__": where}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    if isinstance(value, Mapping):
        wrong = [key for key in value if not isinstance(key, str) or key == "__array__"]
        if wrong:
            raise ValueError(f"{where} has the key {wrong[0]!r}: keys must be texts")
        return {key: encode_tree(item, arrays, f"{where}/{key}") for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [encode_tree(item, arrays, f"{where}/{i}") for i, item in enumerate(value)]
    raise ValueError(f"{where} is a {type(value).__name__}, which can not be stored")


def decode_tree(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """Undo :func:`encode_tree`; tuples have become lists.

    :param value: JSON values
    :param arrays: by place
    :raises ValueError: if the arrays are not those of the tree, each in its place
    """
    left = dict(arrays)
    tree = _decode(value, left, "state")
    if left:
        raise ValueError(f"the array {next(iter(left))!r} is in no place of the state")
    return tree


def _decode(value: Any, arrays: dict[str, np.ndarray], where: str) -> Any:
    if isinstance(value, dict):
        if "__array__" in value:
            if value != {"__array__": where} or where not in arrays:
                raise ValueError(f"{where} names an array that is not there")
            return arrays.pop(where)
        return {key: _decode(item, arrays, f"{where}/{key}") for key, item in value.items()}
    if isinstance(value, list):
        return [_decode(item, arrays, f"{where}/{i}") for i, item in enumerate(value)]
    return value


def parse_json(data: bytes) -> Any:
    """Parse JSON that may come from anybody.

    :param data: UTF-8
    :raises ValueError: if it is none, names a key twice, or takes far more memory or time than its
        size: too many values, or too long numbers
    :raises RecursionError: if it is nested too deeply
    """
    if data.count(b",") + data.count(b"[") + data.count(b"{") > _MAX_VALUES:
        raise ValueError(f"more than {_MAX_VALUES} values")
    return json.loads(data.decode(), object_pairs_hook=_unique, parse_int=_whole)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key is there twice")
    return found


def _whole(digits: str) -> int:
    if len(digits) > _MAX_DIGITS:
        raise ValueError(f"a number of {len(digits)} digits")
    return int(digits)
