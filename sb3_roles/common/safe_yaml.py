"""YAML of data, which may come from anybody."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import yaml

_MAX_VALUES = 100_000
_MAX_NUMBER = 100


def parse_yaml(text: str) -> Any:
    """Parse a document as ``yaml.safe_load`` does, without what is small as text only.

    Aliases are taken, but not where they stand for more values than anybody writes, or for what
    they are part of; messages that show a value would take all memory.

    :param text: one document
    :raises yaml.YAMLError: if it is none
    :raises ValueError: if its values are too many, refer to themselves, or are too long numbers
    :raises RecursionError: if it is nested too deeply
    """
    import yaml

    loader = yaml.SafeLoader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _count(node, {}) > _MAX_VALUES:
            raise ValueError(f"more than {_MAX_VALUES} values, aliases counted as what they mean")
        return loader.construct_document(node)
    finally:
        loader.dispose()


def _count(node: yaml.Node, known: dict[yaml.Node, int]) -> int:
    """Return the number of values that a node stands for."""
    import yaml

    if node not in known:
        # Met again below itself, a node is one of endlessly many.
        known[node] = _MAX_VALUES
        total = 1
        if isinstance(node, yaml.ScalarNode):
            number = node.tag in ("tag:yaml.org,2002:int", "tag:yaml.org,2002:float")
            if number and len(node.value) > _MAX_NUMBER:
                raise ValueError(f"a number of {len(node.value)} characters")
        else:
            pairs = isinstance(node, yaml.MappingNode)
            for one in node.value:
                total += sum(_count(part, known) for part in (one if pairs else (one,)))
        known[node] = total
    return known[node]
