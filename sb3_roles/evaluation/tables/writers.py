"""Tables as Markdown, LaTeX and CSV."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

from sb3_roles.common.files import csv_bytes
from sb3_roles.evaluation.tables.model import TableResult, TableRow, Value
from sb3_roles.evaluation.tables.text import Line, Text, blocks_of

CSV_COLUMNS = (
    "table",
    "row",
    "label",
    "n_agents",
    "scene",
    "metric",
    "mean",
    "low",
    "high",
    "unit",
    "printed",
    "paper",
    "difference",
    "best",
    "share",
    "n_episodes",
    "n_seeds",
    "budget",
    "drawn",
    "bound",
    "decision_us",
    "batch",
    "quick",
)
"""Header of the CSV file."""
ALL_SCENES = "all"
"""What the CSV file has as scene for a number over all scenes of a table."""

_FIXED = "\N{NO-BREAK SPACE}"


def to_markdown(tables: Mapping[str, TableResult]) -> str:
    """Write tables for people: a block for each number of robots, with its lines by metric.

    A cell reads ``mean ± half the interval (the paper's number, the difference to it)``; what holds
    for all tables is said once, at the top.

    :param tables: at least one
    """
    common = _common_notes(tables)
    parts = ["# Tables", "## The rows", _about(tables)]
    if common:
        parts += ["## How to read the tables", _bullets(common)]
    for table in tables.values():
        parts.append(f"## {markdown_text(table.caption)}")
        blocks = blocks_of(table)
        for block in blocks:
            if len(blocks) > 1:
                parts.append(f"### {block.n_agents} robots")
            lines = [[markdown_text(cell) for cell in block.header]]
            for metric, group in block.groups.items():
                lines.append([f"**{markdown_text(metric)}**", *[""] * (len(block.header) - 1)])
                lines += [_markdown_line(line) for line in group]
            parts.append(aligned(lines))
        own = [note for note in table.notes if note not in common]
        if own:
            parts.append(_bullets(own))
    return "\n\n".join(parts) + "\n"


def _about(tables: Mapping[str, TableResult]) -> str:
    rows = {row.name: row for table in tables.values() for row in table.rows}
    lines = [["Method", "What it is", "Trained for"]]
    lines += [
        [markdown_text(r.label), markdown_text(r.about), markdown_text(r.budget)]
        for r in rows.values()
    ]
    return aligned(lines, texts=None)


def _common_notes(tables: Mapping[str, TableResult]) -> list[str]:
    first, *others = tables.values()
    return [note for note in first.notes if others and all(note in t.notes for t in others)]


def _bullets(notes: Sequence[str]) -> str:
    return "\n".join(f"* {markdown_text(note)}" for note in notes)


def markdown_text(text: str) -> str:
    """Return a text that Markdown shows as it is."""
    return re.sub(r"([\\|*<`\[])", r"\\\1", text)


def _markdown_line(line: Line) -> list[str]:
    label = markdown_text(line.label)
    cells = [_markdown_cell(cell) for cell in line.cells]
    return [f"*{label}*" if line.bound else label, *cells, line.decision.replace(" ", _FIXED)]


def _markdown_cell(cell: Text) -> str:
    text = _joined(cell, f"**{cell.mean}**" if cell.best else cell.mean, "±")
    # On a narrow page, a line may end between our number and the paper's, and nowhere else.
    return text.replace(" ", _FIXED).replace(f"{_FIXED}(", " (")


def _joined(cell: Text, mean: str, plus_minus: str) -> str:
    half = f" {plus_minus} {cell.half}" if cell.half else ""
    beside = f" ({', '.join(cell.beside)})" if cell.beside else ""
    return f"{mean}{half}{beside}"


def aligned(lines: Sequence[Sequence[str]], texts: int | None = 1) -> str:
    """Return a Markdown table whose cells are padded, so that it can be read as text, too.

    :param lines: of cells, the header first; a line of one cell, and empty ones, goes across
    :param texts: columns that are flush left, the others are flush right; None for all
    """
    # The name of a metric goes beyond its column, which is only as wide as the names of the rows.
    widths = [
        max(len(line[k]) for line in lines if k or line is lines[0] or any(line[1:]))
        for k in range(len(lines[0]))
    ]
    left = len(widths) if texts is None else texts
    rule = [":" + "-" * (width - 1) for width in widths]
    rule[left:] = [text[::-1] for text in rule[left:]]
    padded = []
    for line in [lines[0], rule, *lines[1:]]:
        cells = [
            cell.ljust(width) if k < left else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(line, widths, strict=True))
        ]
        padded.append(f"| {' | '.join(cells)} |")
    return "\n".join(padded)


_LATEX = {
    "\\": r"\textbackslash{}",
    "%": r"\%",
    "_": r"\_",
    "&": r"\&",
    "#": r"\#",
    "$": r"\$",
    "{": r"\{",
    "}": r"\}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "±": r"$\pm$",
    "µ": r"$\mu$",
    "\N{EN DASH}": "--",
    "\N{DAGGER}": r"\dag{}",
    "\N{DOUBLE DAGGER}": r"\ddag{}",
}


def to_latex(tables: Mapping[str, TableResult]) -> str:
    r"""Write tables for a paper, to be used by ``\input``: floats over both columns of a page.

    :param tables: at least one
    """
    parts = [
        "% Needs \\usepackage{booktabs} and \\usepackage{graphicx}.\n"
        "% mean +- half of the 95 % interval (the paper's number, the difference to it)"
    ]
    for table in tables.values():
        parts += ["\n".join(lines) for lines in _floats(table)]
    return "\n\n".join(parts) + "\n"


def _floats(table: TableResult) -> Iterator[list[str]]:
    blocks, name = blocks_of(table), table.spec.name
    # LaTeX numbers them itself.
    caption = table.caption.removeprefix(f"Table {name}. ")
    for block in blocks:
        width = len(block.header)
        team = f" {block.n_agents} robots." if len(blocks) > 1 else ""
        lines = [
            r"\begin{table*}",
            r"\centering",
            rf"\caption{{{latex_text(caption + team)}}}",
            rf"\label{{tab:{name.replace('_', '-')}-{block.n_agents}}}",
            r"\scriptsize",
            # No wider than the page, and as it is where it is narrower.
            r"\resizebox{\ifdim\width>\textwidth\textwidth\else\width\fi}{!}{%",
            rf"\begin{{tabular}}{{l{'r' * (width - 1)}}}",
            r"\toprule",
            _latex_line([latex_text(cell) for cell in block.header]),
        ]
        for metric, group in block.groups.items():
            lines += [r"\midrule", rf"\multicolumn{{{width}}}{{l}}{{{latex_text(metric)}}} \\"]
            for line in group:
                label = latex_text(line.label)
                cells = [_latex_cell(cell) for cell in line.cells]
                label = rf"\emph{{{label}}}" if line.bound else rf"{label}"
                lines.append(_latex_line([label, *cells, latex_text(line.decision)]))
        notes = " ".join(latex_text(note) for note in table.notes)
        lines += [
            r"\bottomrule",
            r"\end{tabular}}",
            rf"\par\smallskip\parbox{{\textwidth}}{{\scriptsize {notes}}}",
            r"\end{table*}",
        ]
        yield lines


def latex_text(text: str) -> str:
    """Escape what LaTeX would not print as it is.

    :param text: plain text
    """
    return "".join(_LATEX.get(character, character) for character in text)


def _latex_line(cells: Sequence[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _latex_cell(cell: Text) -> str:
    mean = rf"\textbf{{{latex_text(cell.mean)}}}" if cell.best else latex_text(cell.mean)
    # Signs as in formulas, and not the two hyphens of a dash.
    beside = tuple(re.sub(r"^([+-])(?=\d)", r"$\1$", latex_text(text)) for text in cell.beside)
    return _joined(cell._replace(beside=beside), mean, r"$\pm$")


def to_csv(tables: Mapping[str, TableResult]) -> bytes:
    """Write the numbers of tables for programs: one line per table, row, team, scene and metric.

    Numbers have all their digits; what does not exist, or was not played, is empty. ``printed``
    with an empty ``paper`` is a printed dash. ``scene`` is ``all`` for a number over all scenes.

    :param tables: at least one
    :return: UTF-8
    """
    records = (
        record for table in tables.values() for row in table.rows for record in _records(table, row)
    )
    return csv_bytes(CSV_COLUMNS, ([one.get(name) for name in CSV_COLUMNS] for one in records))


def _records(table: TableResult, row: TableRow) -> Iterator[dict[str, object]]:
    common = {
        "table": table.spec.name,
        "row": row.name,
        "label": row.label,
        "budget": row.budget,
        "drawn": _flag(row.drawn),
        "bound": _flag(row.bound),
        "quick": _flag(table.quick),
    }
    for metric in table.spec.metrics:
        for column in table.spec.columns:
            place = {"n_agents": column.n_agents, "scene": column.scene, "metric": metric}
            value = row.values.get((column, metric))
            if value is None:
                key = (row.name, column, metric)
                numbers: dict[str, object] = {
                    "printed": _flag(key in table.spec.paper),
                    "paper": table.spec.paper.get(key),
                }
            else:
                numbers = {**_numbers(value), "decision_us": 1e6 * row.decision[column]}
                numbers["batch"] = row.batch
            yield {**common, **place, **numbers}
        for (n_agents, name), value in row.overall.items():
            if name == metric:
                place = {"n_agents": n_agents, "scene": ALL_SCENES, "metric": metric}
                yield {**common, **place, **_numbers(value)}


def _numbers(value: Value) -> dict[str, object]:
    names = ("mean", "low", "high", "unit", "paper", "difference", "share", "n_episodes", "n_seeds")
    flags = ("printed", "best")
    return {
        **{name: getattr(value, name) for name in names},
        **{name: _flag(getattr(value, name)) for name in flags},
    }


def _flag(flag: bool) -> str:
    return "true" if flag else "false"
