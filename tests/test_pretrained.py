"""Weights that come with the package: whatever is there is sound, and every command takes it."""

from __future__ import annotations

import csv
import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from grids import plan_data
from published_runs import make_run

from sb3_roles import pretrained
from sb3_roles.common.actor_weights import ACTORS, HOLDS, actor_weights
from sb3_roles.common.checkpoint import read_checkpoint
from sb3_roles.zoo import published as published_module
from sb3_roles.zoo.cli import main, make_parser
from sb3_roles.zoo.config import read_run_config
from sb3_roles.zoo.entrants import find_entrants
from sb3_roles.zoo.model_card import CARD, check_files, read_card, render
from sb3_roles.zoo.plans import learned_rows, read_plan_file
from sb3_roles.zoo.published import published
from sb3_roles.zoo.row_runs import Run, fits
from sb3_roles.zoo.train_jobs import GIVEN, new_jobs

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = [one for ones in published().values() for one in ones]
TINY = ("--episodes", "2", "--n-agents", "2", "--scene", "easy", "--json")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder like the package's: two seeds of one row, and a row whose actions are drawn."""
    root = tmp_path_factory.mktemp("published")
    args = ["publish", "-o", str(root / "pretrained")]
    for row, seed in (("mappo", 1), ("mappo", 12), ("ecc", 0)):
        make_run(root / f"{row}_{seed}", row, seed)
        args += ["--runs", f"{row}={root}/{row}_{seed}"]
    assert main(args) == 0
    return root / "pretrained"


@pytest.fixture
def ship(folder, tmp_path, monkeypatch):
    """Let a copy of that folder be the package's, and the current one be empty."""
    shutil.copytree(folder, tmp_path / "package")
    monkeypatch.setattr(published_module, "FOLDER", tmp_path / "package")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER"):
        monkeypatch.delenv(name, raising=False)
    return tmp_path / "package"


# What the package holds


def test_weights_are_those_of_learned_rows():
    assert set(pretrained.names()) <= set(learned_rows(read_plan_file()))
    sizes = [path.stat().st_size for one in SHIPPED for path in one.folder.rglob("*")]
    assert sum(sizes) < 8_000_000
    for name in pretrained.names():
        # Runs of different length are no sample of one method.
        cards = [pretrained.card(name, seed) for seed in pretrained.seeds(name)]
        assert len({card["planned_env_steps"] for card in cards}) == 1, name


def check_published(one: Any) -> None:
    """Hold what is published against its card, and the card against the row and itself."""
    facts = read_card(one.folder)
    row = learned_rows(read_plan_file())[one.row]
    assert (one.folder / CARD).read_text() == render(facts)
    check_files(one.folder, facts)
    there = {p.relative_to(one.folder).as_posix() for p in one.folder.rglob("*") if p.is_file()}
    assert there == {CARD, *facts["files"]}
    assert (facts["row"], facts["seed"], facts["drawn"]) == (one.row, one.seed, row.drawn)
    config = read_run_config(one.folder)
    for name, key in (("algorithm", "algo"), ("environment", "env"), ("seed", "seed")):
        assert facts[name] == config[key]
    assert facts["planned_env_steps"] == config["n_timesteps"]
    assert fits(Run(one.folder, config), row)
    checkpoint = read_checkpoint(one.folder / facts["weights"]["file"])
    assert checkpoint.manifest[HOLDS] == ACTORS
    assert checkpoint.manifest["env_steps"] == facts["env_steps"] > 0
    assert sum(t.numel() for t in checkpoint.policy.values()) == facts["weights"]["parameters"]
    found = {str(tensor.dtype) for tensor in checkpoint.policy.values()}
    assert f"torch.{facts['weights']['dtype']}" in found
    controller = one.load().controller(not facts["drawn"], True)
    assert list(checkpoint.policy) and set(checkpoint.policy) == set(
        actor_weights(controller.policy)
    )
    points = facts["curve"]["points"]
    if points:
        with open(one.folder / "evaluations.csv", newline="", encoding="utf-8") as file:
            last = list(csv.DictReader(file))[-1]
        assert points[-1][0] == int(last["env_steps"])
        assert points[-1][-1] == pytest.approx(float(last["cover"]), abs=1e-4)
    for cell in (facts["scores"] or {"cells": ()})["cells"]:
        score = dict(zip(facts["scores"]["columns"], cell, strict=True))
        assert score["cover_low"] <= score["cover"] <= score["cover_high"]
        assert score["episodes"] > 0
    assert not any(
        word in content
        for path in one.folder.rglob("*")
        if path.suffix in (".md", ".yml", ".csv")
        for content in [path.read_text()]
        for word in ("/tmp", "/home", "/work", "/root")
    )
    # The command of the card, from the root of the repository.
    words = shlex.split(facts["training"]["command"])[1:]
    where = words.index("--conf-file") + 1
    assert words[where] == f"sb3_roles/pretrained/{one.row}/{one.folder.name}/config.yml"
    words[where] = str(one.folder / "config.yml")
    given = vars(make_parser().parse_args(words))
    _, (job,) = new_jobs({k: v for k, v in given.items() if k in GIVEN and v is not None})
    assert job["config"] == config


@pytest.mark.parametrize("one", SHIPPED, ids=lambda one: one.name)
def test_what_is_shipped_is_what_its_card_says(one):
    check_published(one)


def test_what_publish_writes_is_what_its_card_says(folder):
    found = [one for ones in published(folder).values() for one in ones]
    assert [one.name for one in found] == ["ecc/seed_0", "mappo/seed_1", "mappo/seed_12"]
    for one in found:
        check_published(one)
    with pytest.raises(AssertionError):
        wrong = published_module.Published("mappo", 0, found[0].folder)
        check_published(wrong)


# From Python


def test_weights_are_loaded_by_name(ship):
    from sb3_roles.evaluation.episodes import run_episodes

    assert pretrained.names() == ("ecc", "mappo")
    assert pretrained.seeds("mappo") == (1, 12)
    first, second = (pretrained.load("mappo", seed) for seed in (None, 12))
    assert first.deterministic
    assert first.description["weights"] != second.description["weights"]
    assert first.description == pretrained.load("mappo/seed_1").description
    assert pretrained.card("mappo")["seed"] == 1
    # As the tables play it.
    drawn = pretrained.load("ecc")
    assert not drawn.deterministic
    assert pretrained.load("ecc", deterministic=True).deterministic
    assert not pretrained.load("mappo", communicate=False).communicate
    records = run_episodes(drawn, "easy", 2, 3, n_agents=2)
    assert records.length.min() > 0
    model = pretrained.load_model("mappo")
    assert model.num_timesteps == 4 * 9600
    for name, said in (("mapo", "did you mean 'mappo'"), ("mappo/seed_2", "seed_12")):
        with pytest.raises(ValueError, match=said):
            pretrained.load(name)


def test_importing_it_brings_nothing_heavy():
    import subprocess
    import sys

    code = "import sys; from sb3_roles import pretrained; print('torch' in sys.modules)"
    result = subprocess.run(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": f"{ROOT / 'envs'}:{ROOT}"},
        capture_output=True,
        text=True,
    )
    assert result.stdout.strip() == "False", result.stderr


# From the command line


def test_they_are_watched(ship, tell):
    code, printed, _ = tell("enjoy", "--pretrained", "--algo", "mappo", "--scene", "easy")
    assert code == 0
    assert printed.startswith(f"mappo on area-search-v0, {ship}/mappo/seed_1\n")
    assert "length 50" in printed
    args = ("--no-render", "--env-kwargs", "horizon:4", "--n-agents", "3")
    code, printed, _ = tell("enjoy", "--pretrained", "mappo/seed_12", *args)
    assert (code, "mappo/seed_12\n" in printed) == (0, True)
    drawn, again, likeliest = (
        tell("enjoy", "--pretrained", "ecc", "--no-render", *more)[1]
        for more in ((), ("--stochastic",), ("--deterministic",))
    )
    assert drawn == again != likeliest


def test_they_are_controllers(ship, tell):
    code, printed, _ = tell("evaluate", "--controller", "mappo,ecc,random", *TINY)
    assert code == 0
    reports = json.loads(printed)["controllers"]
    assert [one["config"]["controller"] for one in reports] == ["mappo", "ecc", "random"]
    assert [one["config"]["deterministic"] for one in reports] == [True, False, None]
    code, printed, _ = tell("evaluate", "--controller", "ecc", "--deterministic", *TINY)
    assert json.loads(printed)["config"]["deterministic"] is True
    # A folder of that name that is no run does not hide them; a run does.
    Path("mappo").mkdir()
    other = json.loads(tell("evaluate", "--controller", "mappo", *TINY)[1])
    assert other["metrics"] == reports[0]["metrics"]
    shutil.rmtree("mappo")
    shutil.copytree(ship / "mappo" / "seed_12", "mappo")
    other = json.loads(tell("evaluate", "--controller", "mappo", *TINY)[1])
    options = other["config"]["controller_options"]
    assert options["weights"] == pretrained.load("mappo", 12).description["weights"]


WRONG = [
    (["enjoy", "--pretrained", "mapo"], "did you mean 'mappo'?"),
    (["enjoy", "--pretrained", "--algo", "gnn"], "sb3-roles train --algo gnn"),
    (["enjoy", "--pretrained", "mappo/seed_3"], "allowed are seed_1, seed_12"),
    (["enjoy", "--pretrained", "mappo", "--algo", "hmappo"], "is mappo, not hmappo"),
    (["enjoy", "--pretrained", "mappo", "--env", "toy_envs:PlainEnv"], "is area-search-v0, not"),
    (["enjoy", "--pretrained", "mappo", "-f", "logs"], "--folder: it is of a run"),
    (["enjoy", "--pretrained", "mappo", "--exp-id", "0"], "--exp-id: it is of a run"),
    (["enjoy", "--pretrained", "mappo", "--load-best"], "--load-best: it is of a run"),
    (["enjoy", "--pretrained", "damaged"], "damaged"),
    (["evaluate", "--controller", "mapo"], "did you mean 'mappo'?"),
    (["evaluate", "--controller", "mapo"], "greedy_assigned"),
    (["evaluate", "--controller", "hmappo"], "no trained weights of hmappo come with"),
    (["evaluate", "--controller", "hmappo_paper"], "hmappo_paper.yml"),
    (["evaluate", "--controller", "mappo", "--load-best"], "--load-best"),
    (["evaluate", "--controller", "mappo/seed_3"], "seed_12"),
]


@pytest.mark.parametrize(("args", "part"), WRONG)
def test_wrong_command_lines(args, part, ship, tell):
    code, printed, error = tell(*args)
    assert (code, printed) == (2, "")
    assert part in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("name", [CARD, "config.yml", "checkpoints/step_000000009600.ckpt"])
def test_damage_is_one_line_that_names_the_file(name, ship, tell):
    path = ship / "mappo" / "seed_1" / name
    content = bytearray(path.read_bytes())
    content[len(content) // 3 if name != CARD else 0] ^= 1
    path.write_bytes(bytes(content))
    args = (("enjoy", "--pretrained", "mappo"), ("evaluate", "--controller", "mappo"))
    for words in args:
        code, printed, error = tell(*words)
        assert (code, printed, error.count("\n")) == (2, "", 1)
        assert str(path) in error
        assert "damaged" in error
    if name != CARD:
        path.unlink()
        assert f"{path}: No such file" in tell(*args[0])[2]


def test_without_any_weights_there_is_a_way_to_some(ship, tell):
    shutil.rmtree(ship)
    assert pretrained.names() == ()
    for words in (("enjoy", "--pretrained"), ("evaluate", "--controller", "hmappo")):
        code, printed, error = tell(*words)
        assert (code, printed, error.count("\n")) == (2, "", 1)
        assert "train some with sb3-roles train --algo hmappo" in error
    lines: list[str] = []
    plan = read_plan_file().select(tables=["I"], rows=["mappo"])
    assert find_entrants(plan, Path("logs"), report=lines.append) == {"mappo": []}
    assert lines[0].startswith("mappo has no run in logs: sb3-roles train")


# In the tables


def test_own_runs_come_first(ship, folder):
    plan = read_plan_file().select(tables=["I"], rows=["mappo", "ecc"])
    lines: list[str] = []
    found = find_entrants(plan, Path("logs"), report=lines.append)
    assert [(one.training_seed, one.shipped) for one in found["mappo"]] == [(1, True), (12, True)]
    assert found["ecc"][0].drawn
    assert lines == [
        "ecc: 1 run of 9,600 of 10,000 joint steps, seed 0, as they come with this package",
        "mappo: 2 runs of 9,600 of 10,000 joint steps, seeds 1, 12, as they come with this package",
    ]
    Path("logs", "mappo").mkdir(parents=True)
    own = Path("logs", "mappo", "area-search-v0_1")
    shutil.copytree(folder.parent / "mappo_12", own)
    found = find_entrants(plan, Path("logs"), report=lines.append)
    assert [(one.source, one.shipped) for one in found["mappo"]] == [(str(own), False)]
    assert found["ecc"][0].shipped
    # A run of another configuration is none of the row's.
    config = yaml.safe_load((own / "config.yml").read_text())
    (own / "config.yml").write_text(yaml.safe_dump({**config, "gamma": 0.5}))
    assert len(find_entrants(plan, Path("logs"), report=lines.append)["mappo"]) == 2
    named = find_entrants(plan, Path("logs"), [f"mappo={own}"], lines.append)
    assert [one.shipped for one in named["mappo"]] == [False]
    # Damaged ones are left out, and said.
    (ship / "mappo" / "seed_1" / "config.yml").write_text("algo: [")
    lines.clear()
    found = find_entrants(plan, Path("logs"), report=lines.append)
    assert [one.training_seed for one in found["mappo"]] == [12]
    assert any(line.startswith("not taken: ") and "config.yml" in line for line in lines)


def test_tables_say_that_they_played_and_keep_what_they_played(ship, tell, tmp_path, monkeypatch):
    data = plan_data(("random",))
    data["rows"]["mine"] = {"label": "Mine", "algo": "mappo", "block": 4}
    data["tables"]["I"]["rows"] += ["mine"]
    data["tables"]["I"]["scenes"] = {"easy": "Easy"}
    Path("plan.yml").write_text(yaml.safe_dump({**data, "episodes": 4}))
    # Found by its configuration, whatever the row is called.
    args = ("tables", "--plan", "plan.yml", "--jobs", "1")
    code, printed, _ = tell(*args)
    assert code == 0
    assert "Played by the trained weights that come with this package: Mine." in printed
    records = sorted(Path("results").rglob("*.parquet"))
    assert len([path for path in records if "mine" in path.parts]) == 2
    # Wherever the package lies.
    shutil.move(ship, tmp_path / "elsewhere")
    monkeypatch.setattr(published_module, "FOLDER", tmp_path / "elsewhere")
    assert tell(*args)[1].splitlines() == printed.splitlines()
    assert sorted(Path("results").rglob("*.parquet")) == records


def test_only_rows_that_were_played_by_them_are_named(ship, tell):
    data = plan_data(("random",))
    Path("plan.yml").write_text(yaml.safe_dump({**data, "episodes": 2}))
    assert "come with this package" not in tell("tables", "--plan", "plan.yml", "--jobs", "1")[1]


def test_reading_names_is_no_reading_of_weights(ship):
    """Names need no torch, and a damaged card stops only who asks for it."""
    (ship / "ecc" / "seed_0" / CARD).write_text("---\nrow: [")
    assert pretrained.names() == ("ecc", "mappo")
    assert np.isfinite(pretrained.card("mappo")["env_steps"])
    with pytest.raises(ValueError, match="damaged"):
        pretrained.card("ecc")
