"""What ``zoo_configs/ablations.yml`` says: variants of a training, and studies of some of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sb3_roles.common.roles import LEARNED, role_controls
from sb3_roles.evaluation.grid.fields import (
    FLAG,
    MAPPING,
    NAMES,
    SEED,
    TEXT,
    Check,
    check_names,
    fields,
    line,
    list_of,
    named,
    note,
    whole,
)
from sb3_roles.evaluation.grid.plan import SCORES, Column, Plan, PlanError, Row, Table
from sb3_roles.evaluation.grid.plan_file import columns_of
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.config import merge
from sb3_roles.zoo.options import MAX_TRAINING_SEED

METRICS = tuple(metric for metric in SCORES if metric != "t90_true")
"""What the tables of studies show."""

_BUDGET, _SEEDS = whole(1, 10**12), list_of(int, "whole numbers")
_PLACES: dict[str, Check] = {"scenes": MAPPING, "n_agents": list_of(int, "numbers of robots")}
_TOP: dict[str, Check] = {
    "episodes": whole(1),
    "seed": SEED,
    "n_timesteps": _BUDGET,
    "seeds": _SEEDS,
    **_PLACES,
    "variants": MAPPING,
    "studies": MAPPING,
}
_VARIANT: dict[str, Check] = {
    "label": line,
    "of": TEXT,
    "algo": TEXT,
    "conf": TEXT,
    "params": MAPPING,
    "drawn": FLAG,
    "n_timesteps": _BUDGET,
    "seeds": _SEEDS,
    "note": note,
}
_STUDY: dict[str, Check] = {
    "caption": line,
    "reference": TEXT,
    "variants": NAMES,
    "played": NAMES,
    **_PLACES,
    "note": note,
}


@dataclass(frozen=True)
class Variant:
    """One way to train, or to play what was trained.

    :param row: who plays; its ``about`` is the note
    :param n_timesteps: joint steps of a training
    :param seeds: of the trainings
    :param runs_of: name of the variant whose runs play: its own, but where only the roles are
        others while they play
    """

    row: Row
    n_timesteps: int
    seeds: tuple[int, ...]
    runs_of: str


@dataclass(frozen=True)
class Study:
    """Variants that are compared with one of them, on the same episodes.

    :param name: key in the file
    :param caption: without a full stop
    :param reference: name of the variant that the others are compared with
    :param variants: names, the reference first
    :param columns: where they play
    :param scenes: scene -> what readers see
    :param note: for readers
    """

    name: str
    caption: str
    reference: str
    variants: tuple[str, ...]
    columns: tuple[Column, ...]
    scenes: Mapping[str, str]
    note: str = ""


@dataclass(frozen=True)
class Ablations:
    """All of the file.

    :param episodes: that each run plays in each column
    :param seed: of the held-out stream
    :param variants: by name; of those that only play with other roles, the ones that studies name
    :param studies: by name
    """

    episodes: int
    seed: int
    variants: Mapping[str, Variant]
    studies: Mapping[str, Study]

    def select(
        self,
        studies: Sequence[str] | None = None,
        scenes: Sequence[str] | None = None,
        n_agents: Sequence[int] | None = None,
    ) -> Ablations:
        """Return some of the studies, elsewhere if it is said where.

        :param studies: names; None for all
        :param scenes: instead of those of the studies
        :param n_agents: numbers of robots, instead of those of the studies
        :raises PlanError: for a study or scene that does not exist, or a wrong number
        """
        if studies is not None:
            check_names("--studies", "study", studies, self.studies)
        chosen = {}
        for name, study in self.studies.items():
            if studies is None or name in studies:
                labels = {scene: study.scenes.get(scene, scene) for scene in scenes or study.scenes}
                teams = list(n_agents or dict.fromkeys(one.n_agents for one in study.columns))
                columns = columns_of("--scenes", {"scenes": labels, "n_agents": teams})
                chosen[name] = replace(study, columns=columns, scenes=labels)
        used = {name for study in chosen.values() for name in study.variants}
        kept = {name: one for name, one in self.variants.items() if name in used}
        return replace(self, variants=kept, studies=chosen)

    def plan(self) -> Plan:
        """Return what is to be played: a table for each study."""
        tables = {
            study.name: Table(
                study.name,
                study.caption,
                study.columns,
                study.scenes,
                METRICS,
                study.variants,
                {},
            )
            for study in self.studies.values()
        }
        rows = {name: variant.row for name, variant in self.variants.items()}
        return Plan(self.episodes, self.episodes, self.seed, rows, tables, {})


def parse_ablations(content: object) -> Ablations:
    """Check what the file says, but for the configurations of its variants.

    :param content: plain data
    :raises PlanError: naming the first thing that is wrong
    """
    top = fields("the file", content, _TOP)
    columns_of("the file", top)
    _check_seeds("the file", top["seeds"])
    variants: dict[str, Variant] = {}
    given: dict[str, dict[str, Any]] = {}
    for name, value in named("variants", top["variants"]).items():
        given[name] = _whole_variant(name, value, given)
        variants[name] = _variant(name, given[name], top)
    studies = {}
    for name, value in named("studies", top["studies"]).items():
        studies[name] = _study(name, value, variants, top)
    return Ablations(top["episodes"], top["seed"], variants, studies)


def _check_seeds(where: str, seeds: Sequence[int]) -> None:
    wanted = [whole(0, MAX_TRAINING_SEED)(seed) for seed in seeds]
    for seed, problem in zip(seeds, wanted, strict=True):
        if problem is not None:
            raise PlanError(f"{where}: seeds must be {problem}, got {seed!r}")


def _whole_variant(name: str, content: object, known: Mapping[str, Any]) -> dict[str, Any]:
    """Return a variant with what it takes over from the one that it is a change of."""
    where = f"variant {name}"
    given = fields(where, content, _VARIANT, ["label"])
    if ("of" in given) == ("algo" in given):
        raise PlanError(f"{where}: give either algo, or of: the variant above that it changes")
    if "algo" in given:
        return given
    if "conf" in given:
        raise PlanError(f"{where}: conf belongs to algo: a change of another variant has params")
    check_names(where, "variant above", [given["of"]], known)
    base = known[given.pop("of")]
    params = merge(base.get("params", {}), given.get("params", {}))
    own = {key: value for key, value in base.items() if key != "note"}
    return {**own, **given, "params": params}


def _variant(name: str, given: Mapping[str, Any], top: Mapping[str, Any]) -> Variant:
    where, params = f"variant {name}", given.get("params", {})
    if "n_timesteps" in params:
        raise PlanError(f"{where}: n_timesteps belongs beside params")
    seeds = given.get("seeds", top["seeds"])
    _check_seeds(where, seeds)
    row = Row(
        name,
        given["label"],
        algo=given["algo"],
        conf=given.get("conf"),
        params=params,
        drawn=given.get("drawn", False),
        about=given.get("note", ""),
    )
    budget = given.get("n_timesteps", top["n_timesteps"])
    return Variant(row, budget, tuple(sorted(seeds)), name)


def _study(
    name: str, content: object, variants: dict[str, Variant], top: Mapping[str, Any]
) -> Study:
    where = f"study {name}"
    given = fields(where, content, _STUDY, ("caption", "reference"))
    if "variants" not in given and "played" not in given:
        raise PlanError(f"{where}: give variants, or played, or both")
    reference, others = given["reference"], given.get("variants", [])
    check_names(where, "variant", [reference, *others], top["variants"])
    if reference in others:
        raise PlanError(f"{where}: the reference {reference} is no variant of itself")
    played = [_played(where, variants, reference, how) for how in given.get("played", [])]
    place = {key: given.get(key, top[key]) for key in _PLACES}
    names = (reference, *played, *others)
    columns, note = columns_of(where, place), given.get("note", "")
    return Study(name, given["caption"], reference, names, columns, place["scenes"], note)


def _played(where: str, variants: dict[str, Variant], reference: str, control: str) -> str:
    """Add the variant that is the reference, with roles that are chosen in another way."""
    row = variants[reference].row
    algorithm = ALGORITHMS.get(row.algo or "")
    if algorithm is not None and not (algorithm.wrapper == "role" and algorithm.holds_roles):
        raise PlanError(f"{where}: played: {row.algo} has no roles that others could replace")
    wrapper = row.params.get("wrapper_kwargs") or {}
    roles = wrapper.get("roles", ("explore", "cover"))
    allowed = [name for name in role_controls(roles) if name != LEARNED]
    check_names(where, "way to choose roles", [control], allowed)
    name = f"{reference}_plays_{control}"
    if name in variants and variants[name].runs_of == name:
        raise PlanError(f"{where}: the variant {name} has the name of a reference that is played")
    label = f"{row.label}, played with {_CONTROLS.get(control, control)} roles"
    changed = replace(row, name=name, label=label, role_control=control, about="")
    variants[name] = replace(variants[reference], row=changed)
    return name


_CONTROLS = {"nearest": "rule (nearest)", "explore": "fixed explore", "cover": "fixed cover"}
