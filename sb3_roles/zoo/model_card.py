"""The card of published weights: one Markdown file, whose head is data and whose text repeats it.

The head is YAML between two lines of ``---``; the text is a function of it, so neither can say what
the other does not.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_roles.common.durations import long_duration
from sb3_roles.common.files import open_regular
from sb3_roles.common.yaml_text import load_yaml
from sb3_roles.zoo.options import UsageError

CARD = "README.md"
SCORES = ("explo_paper", "explo_true", "cover", "time_e_paper", "t90_true")
"""Metrics of a card: those of the tables."""
SCORE_COLUMNS = (
    "scene",
    "n_agents",
    "episodes",
    *(f"{metric}{end}" for metric in SCORES for end in ("", "_low", "_high")),
    "t90_true_share",
)
"""What a line of the scores says: percent, and steps for times; the ends of 95 % intervals."""
CURVE_COLUMNS = ("env_steps", "explo_paper", "explo_true", "cover")
"""What a point of the learning curve says: joint steps, and fractions."""
_FENCE = "---\n"
_FACTS: dict[str, type | tuple[type, ...]] = {
    "row": str,
    "label": str,
    "about": str,
    "algorithm": str,
    "environment": str,
    "seed": int,
    "drawn": bool,
    "env_steps": int,
    "planned_env_steps": int,
    "chosen": str,
    "wall_time_s": (int, float, type(None)),
    "training": dict,
    "publishing": dict,
    "weights": dict,
    "curve": dict,
    "scores": (dict, type(None)),
    "files": dict,
}


_MAX_BYTES = 1 << 20


class CardError(UsageError):
    """A card that can not be read, or files that are not what it says; one line."""


def render(facts: Mapping[str, Any]) -> str:
    """Write a card.

    :param facts: what :func:`read_card` returns
    """
    import yaml

    head = yaml.safe_dump(
        dict(facts), sort_keys=False, allow_unicode=True, width=10**6, default_flow_style=None
    )
    return f"{_FENCE}{head}{_FENCE}\n" + "\n".join(_text(facts)).rstrip() + "\n"


def read_card(folder: Path) -> dict[str, Any]:
    """Read the facts of a card.

    :param folder: of published weights
    :return: by the names in the head
    :raises CardError: if there is none, or a fact is missing
    """
    path = folder / CARD
    try:
        with open_regular(path) as file:
            text = file.read(_MAX_BYTES).decode()
        before, head, _ = text.split(_FENCE, 2)
        facts = load_yaml(head)
    except OSError as error:
        raise CardError(f"{path}: {error.strerror or error}") from None
    except ValueError:
        raise CardError(f"{path}: damaged: it has no head of data") from None
    if before or not isinstance(facts, dict):
        raise CardError(f"{path}: damaged: it has no head of data")
    for name, kind in _FACTS.items():
        if not isinstance(facts.get(name), kind):
            raise CardError(f"{path}: damaged: {name} is {facts.get(name)!r}")
    return facts


def facts_of_file(path: Path) -> dict[str, Any]:
    """Return what a card says of a file: ``bytes`` and ``sha256``."""
    digest, size = hashlib.sha256(), 0
    with open_regular(path) as file:
        while content := file.read(1 << 20):
            digest.update(content)
            size += len(content)
    return {"bytes": size, "sha256": digest.hexdigest()}


def check_files(folder: Path, facts: Mapping[str, Any]) -> None:
    """Refuse files that are not those of a card.

    :param folder: of published weights
    :param facts: of its card
    :raises CardError: naming a file that is missing, or another one
    """
    for name, wanted in facts["files"].items():
        path = folder / str(name)
        if Path(str(name)).is_absolute() or ".." in Path(str(name)).parts:
            raise CardError(f"{folder / CARD}: damaged: {path} is not in its folder")
        try:
            found = facts_of_file(path)
        except OSError as error:
            raise CardError(f"{path}: {error.strerror or error}") from None
        if found != wanted:
            raise CardError(f"{path}: damaged: it is not the file that {CARD} lists")


# The text


def _text(facts: Mapping[str, Any]) -> Iterator[str]:
    name = f"{facts['row']}/seed_{facts['seed']}"
    about = f" ({facts['about']})" if facts["about"] else ""
    yield f"# {facts['label']}, training seed {facts['seed']}"
    yield ""
    yield f"Trained weights of the row `{facts['row']}` of the tables{about}, to act with:"
    yield ""
    yield "```sh"
    yield f"python enjoy.py --pretrained {name}"
    yield f"sb3-roles evaluate --controller {name}"
    yield "```"
    yield ""
    yield "```python"
    yield "from sb3_roles import pretrained"
    yield f'controller = pretrained.load("{facts["row"]}", seed={facts["seed"]})'
    yield "```"
    yield ""
    yield from _training(facts)
    yield from _curve(facts["curve"])
    yield from _scores(facts["scores"])
    yield from _files(facts)


def _training(facts: Mapping[str, Any]) -> Iterator[str]:
    training, publishing, weights = facts["training"], facts["publishing"], facts["weights"]
    done, planned = facts["env_steps"], facts["planned_env_steps"]
    seconds = facts["wall_time_s"]
    which = "the best of its evaluations" if facts["chosen"] == "best" else "the latest"
    acts = "drawn, as in training" if facts["drawn"] else "the likeliest ones"
    resumed = training["commands"] - 1
    yield "## Training"
    yield ""
    yield f"* Algorithm `{facts['algorithm']}` on `{facts['environment']}`, with `config.yml`."
    yield f"* Weights after {done:,} joint steps of {planned:,} planned ones: {which}."
    yield f"* Time: {'unknown' if seconds is None else long_duration(seconds)}" + (
        f"; resumed {resumed} time{'s' * (resumed > 1)}." if resumed else "."
    )
    yield f"* Commit: {training['commit'] or 'unknown'}; {_versions(training['versions'])}."
    yield f"* Published from commit {publishing['commit'] or 'unknown'}; " + (
        f"{_versions(publishing['versions'])}."
    )
    yield (
        f"* The file holds the actors, without the critics: {weights['parameters']:,} numbers, "
        f"stored as {weights['dtype']}. Actions: {acts}."
    )
    for name, value in training.get("demonstrations", {}).items():
        yield f"* Demonstrations, {name}: {value}."
    yield ""
    yield "The same training once more, from the root of the repository:"
    yield ""
    yield "```sh"
    yield training["command"]
    yield "```"
    yield ""


def _versions(versions: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in versions.items()) or "no versions"


def _table(header: Sequence[str], lines: Sequence[Sequence[str]]) -> Iterator[str]:
    yield f"| {' | '.join(header)} |"
    yield "|---" * len(header) + "|"
    for line in lines:
        yield f"| {' | '.join(line)} |"
    yield ""


def _curve(curve: Mapping[str, Any]) -> Iterator[str]:
    yield "## Learning curve"
    yield ""
    if not curve["points"]:
        yield "The run was not evaluated while it trained."
        yield ""
        return
    yield "Evaluations during the training, on episodes that no score is measured on, in percent:"
    yield ""
    lines = [
        [f"{steps:,}", *("-" if v is None else f"{100 * v:.1f}" for v in values)]
        for steps, *values in curve["points"]
    ]
    yield from _table(("joint steps", *curve["columns"][1:]), lines)


def _scores(scores: Mapping[str, Any] | None) -> Iterator[str]:
    yield "## Scores"
    yield ""
    if scores is None or not scores["cells"]:
        yield "Not measured yet: `sb3-roles tables`, then `sb3-roles publish --scores`."
        yield ""
        return
    yield (
        f"Episodes 0, 1, ... of the {scores['stream'].replace('_', '-')} stream of seed "
        f"{scores['seed']}, which no training plays. In brackets: 95 % intervals over the "
        "episodes. Percent, and steps for times; t90_true with the share of the episodes that get "
        "there."
    )
    yield ""
    lines = []
    for values in scores["cells"]:
        cell = dict(zip(scores["columns"], values, strict=True))
        parts = [f"{cell['scene']}, {cell['n_agents']} robots", str(cell["episodes"])]
        parts += [_score(cell, metric) for metric in SCORES]
        lines.append(parts)
    yield from _table(("cell", "episodes", *SCORES), lines)


def _score(cell: Mapping[str, Any], metric: str) -> str:
    mean, low, high = (cell[f"{metric}{end}"] for end in ("", "_low", "_high"))
    share = f" ({100 * cell['t90_true_share']:.0f} %)" if metric == "t90_true" else ""
    if mean is None:
        return f"-{share}"
    ends = "" if low is None else f" [{low:.1f}, {high:.1f}]"
    return f"{mean:.1f}{ends}{share}"


def _files(facts: Mapping[str, Any]) -> Iterator[str]:
    yield "## Files"
    yield ""
    lines = [
        [f"`{name}`", f"{one['bytes']:,}", f"`{one['sha256']}`"]
        for name, one in facts["files"].items()
    ]
    yield from _table(("file", "bytes", "sha256"), lines)
