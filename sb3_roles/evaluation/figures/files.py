"""A drawn figure as files: the same figure gives the same bytes, wherever it is drawn."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas

# What would tell when and by which version a file was made.
_UNSAID = {
    "svg": ("Creator", "Date", "Format", "Type"),
    "pdf": ("Creator", "Producer", "CreationDate"),
    "png": ("Software",),
}
SUFFIXES = tuple(_UNSAID)
_SVG, _LINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
_STYLE: dict[str, Any] = {
    "axes.grid": True,
    "axes.labelsize": 8,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlesize": 8.5,
    "figure.dpi": 100,
    "font.family": ["sans-serif"],
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8,
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "hatch.linewidth": 0.6,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "lines.linewidth": 1.3,
    # Text that can be searched and copied: no glyphs drawn in Type 3, none as paths.
    "pdf.fonttype": 42,
    "savefig.dpi": 200,
    "svg.fonttype": "none",
    # A dollar in a label is a dollar.
    "text.parse_math": False,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
}


@contextmanager
def drawing_style(name: str) -> Iterator[None]:
    """Draw, and render, in the style of the figures; afterwards everything is as it was before.

    :param name: of the figure
    :raises ImportError: if matplotlib is not there
    """
    try:
        from matplotlib import style
    except ImportError as error:
        raise ImportError(
            f"figures are drawn with matplotlib, which is not here ({error}): "
            "pip install sb3_roles[plots]"
        ) from error
    # Without "default", a matplotlibrc of the user's would decide about the rest.
    with style.context(["default", {**_STYLE, "svg.hashsalt": name}]):
        yield


def render(canvas: Canvas, name: str, about: str) -> dict[str, bytes]:
    """Return the contents of a figure's files; within :func:`drawing_style`.

    :param canvas: the figure
    :param name: its name, a prefix of all ids in the SVG: several can be part of one page
    :param about: what the picture shows, for those who do not see it
    :return: suffix without a dot -> content
    """
    # Laid out once, in the same way for all files.
    canvas.draw_without_rendering()
    canvas.set_layout_engine("none")
    files = {}
    for suffix, unsaid in _UNSAID.items():
        target = io.BytesIO()
        canvas.savefig(target, format=suffix, metadata=dict.fromkeys(unsaid))
        files[suffix] = target.getvalue()
    files["svg"] = _for_pages(files["svg"], name, about)
    return files


def _for_pages(svg: bytes, name: str, about: str) -> bytes:
    """Make ids unique among the SVGs of a page, and styles such that they stay within this one."""
    ElementTree.register_namespace("", _SVG)
    ElementTree.register_namespace("xlink", _LINK)
    root = ElementTree.fromstring(svg)
    for parent in list(root.iter()):
        for child in list(parent):
            # It begins with "*": in a page, that would be every element of it.
            if child.tag == f"{{{_SVG}}}style":
                parent.remove(child)
    for element in root.iter():
        for key, value in element.attrib.items():
            if key in ("d", "x", "y"):
                # Six decimals of a point would be half of the file.
                value = re.sub(r"(\.\d\d)\d+", r"\1", value)
            elif key == "id":
                value = f"{name}-{value}"
            elif key == f"{{{_LINK}}}href" and value.startswith("#"):
                value = f"#{name}-{value[1:]}"
            element.set(key, re.sub(r"url\(#([^)]+)\)", rf"url(#{name}-\1)", value))
    root.set("style", "stroke-linejoin: round; stroke-linecap: butt")
    root.set("role", "img")
    root.set("aria-label", about)
    # Without a declaration, which a page must not have in its middle; UTF-8 needs none.
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=False) + b"\n"
