"""YAML that means what it looks like: what YAML 1.1 would quietly read otherwise is refused.

PyYAML takes the last of two equal keys, ``no`` for False, ``1:30`` for 90, ``010`` for 8 and
``2024-01-01`` for a date, and expands aliases without a bound.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import yaml
from yaml.nodes import MappingNode, Node, ScalarNode

from sb3_roles.common.names import one_line, shown

# Values of a file with all its aliases written out; files of this package have some hundreds.
_MOST_VALUES = 20_000
_DEEPEST = 50
_LONGEST_NUMBER = 100
_NUMBERS = ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")


class YamlError(ValueError):
    """A text that is no YAML, or not what it looks like; one line, with the line's number."""


def load_yaml(text: str) -> Any:
    """Read plain data.

    :param text: one YAML document
    :raises YamlError: if it can not be read, or means something else than a reader would take it
        for
    """
    try:
        loader = _Loader(text)
        try:
            return loader.get_single_data()
        finally:
            loader.dispose()
    except YamlError:
        raise
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = "" if mark is None else f"line {mark.line + 1}: "
        said = ", ".join(part for part in (error.context, error.problem) if part)
        raise YamlError(f"{where}{' '.join(said.split())}") from None
    except (
        yaml.YAMLError,
        RecursionError,
        ValueError,
        # Of values that are not what a tag such as !!int says.
        LookupError,
        TypeError,
        AttributeError,
        OverflowError,
    ) as error:
        raise YamlError(one_line(error)) from None


def _refuse(node: Node, problem: str) -> YamlError:
    return YamlError(f"line {node.start_mark.line + 1}: {problem}")


class _Loader(yaml.SafeLoader):
    """PyYAML's safe loader, without its surprises."""

    _depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        if self._depth > _DEEPEST:
            raise YamlError(f"more than {_DEEPEST} lists and mappings within each other")
        node = super().compose_node(parent, index)
        self._depth -= 1
        return node

    def get_single_node(self) -> Any:
        node = super().get_single_node()
        if node is not None:
            self._count(node, {}, set())
        return node

    def construct_scalar(self, node: Any) -> Any:
        if node.tag in _NUMBERS and len(node.value) > _LONGEST_NUMBER:
            raise _refuse(node, f"a number of {len(node.value)} characters")
        return super().construct_scalar(node)

    def _count(self, node: Node, known: dict[int, int], above: set[int]) -> int:
        """Count the values of a node, those behind aliases as often as they are named."""
        if isinstance(node, ScalarNode):
            return 1
        if id(node) in above:
            raise _refuse(node, "it contains itself")
        if id(node) not in known:
            above.add(id(node))
            parts = (
                [part for pair in node.value for part in pair]
                if isinstance(node, MappingNode)
                else node.value
            )
            known[id(node)] = 1 + sum(self._count(part, known, above) for part in parts)
            above.discard(id(node))
            if known[id(node)] > _MOST_VALUES:
                raise _refuse(node, f"more than {_MOST_VALUES} values, aliases written out")
        return known[id(node)]

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Hashable, Any]:
        if isinstance(node, MappingNode):
            # Before keys of "<<" are merged, which may be there again.
            seen: set[Any] = set()
            for key_node, _ in node.value:
                if key_node.tag == "tag:yaml.org,2002:merge":
                    continue
                key = self.construct_object(key_node, deep=True)
                if not isinstance(key, Hashable):
                    raise _refuse(key_node, "a key must be a name, not a list or mapping")
                if key in seen:
                    raise _refuse(key_node, f"the key {shown(key)} is given twice")
                seen.add(key)
        return super().construct_mapping(node, deep=deep)

    def boolean(self, node: ScalarNode) -> bool:
        if node.value.lower() not in ("true", "false"):
            raise _refuse(
                node,
                f"{node.value} is true or false in YAML: write that, or '{node.value}' for a text",
            )
        return bool(self.construct_yaml_bool(node))

    def whole(self, node: ScalarNode) -> int:
        digits = node.value.lstrip("+-").replace("_", "")
        value = self.construct_yaml_int(node)
        if ":" in digits or (digits.startswith("0") and digits.strip("0") and digits.isdigit()):
            raise _refuse(
                node,
                f"{shown(node.value)} is {shown(value)} in YAML: write that, or quotes for a text",
            )
        return int(value)

    def number(self, node: ScalarNode) -> float:
        value = float(self.construct_yaml_float(node))
        if ":" in node.value:
            raise _refuse(
                node, f"{shown(node.value)} is {value} in YAML: write that, or quotes for a text"
            )
        return value

    def date(self, node: ScalarNode) -> Any:
        raise _refuse(node, f"{node.value} is a date in YAML: write quotes for a text")


for _tag, _method in (
    ("bool", _Loader.boolean),
    ("int", _Loader.whole),
    ("float", _Loader.number),
    ("timestamp", _Loader.date),
):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _method)
