"""``sb3-roles publish``: what it writes, and what it never loses."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
import yaml
from published_runs import COMMIT, make_run

from sb3_roles.common.actor_weights import actor_weights, stored
from sb3_roles.common.checkpoint import CheckpointError, CheckpointFolder, read_checkpoint
from sb3_roles.evaluation.figures.training_logs import read_training_log
from sb3_roles.evaluation.metrics import summarize
from sb3_roles.evaluation.records import read_records
from sb3_roles.zoo import staging
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.card_scores import merged
from sb3_roles.zoo.cli import make_parser
from sb3_roles.zoo.config import read_run_config, resolve
from sb3_roles.zoo.loaded_run import load_run
from sb3_roles.zoo.model_card import CARD, check_files, read_card, render
from sb3_roles.zoo.models import make_env, make_model
from sb3_roles.zoo.run_facts import thinned
from sb3_roles.zoo.train_jobs import GIVEN, new_jobs


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Path:
    """Runs of two rows, ``<row>_<seed>``."""
    folder = tmp_path_factory.mktemp("runs")
    make_run(folder / "mappo_3", "mappo", 3)
    make_run(folder / "ecc_0", "ecc", 0)
    return folder


@pytest.fixture
def tell(tell, tmp_path, monkeypatch):
    """Run commands in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tell


def files_below(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def test_what_is_published_of_a_run(runs, tell, tmp_path):
    out = Path("sb3_roles", "pretrained")
    code, printed, _ = tell("publish", "--runs", f"mappo={runs}/mappo_3", "-o", out)
    assert code == 0
    folder = out / "mappo" / "seed_3"
    assert printed.splitlines()[0].startswith(f"{folder}: 9,600 joint steps, ")
    names = {"checkpoints/step_000000009600.ckpt", "config.yml", "evaluations.csv", "progress.csv"}
    assert set(files_below(folder)) == {CARD, *names}
    assert os.listdir(out / "mappo") == ["seed_3"]
    card = read_card(folder)
    assert (folder / CARD).read_text() == render(card)
    assert set(card["files"]) == names
    check_files(folder, card)
    assert (card["row"], card["algorithm"], card["seed"]) == ("mappo", "mappo", 3)
    assert (card["env_steps"], card["planned_env_steps"]) == (9600, 10_000)
    assert card["training"]["commit"] == COMMIT
    assert card["training"]["versions"] == {
        "sb3_roles": "0.0.9",
        "python": "3.11.7",
        "torch": "2.13.0+cpu",
        "numpy": "unknown",
    }
    assert card["wall_time_s"] == 61
    assert card["curve"]["points"] == [
        [5000, 0.9557, 0.8094, 0.6931],
        [10000, 0.9573, 0.8089, 0.6913],
    ]
    assert card["scores"] is None
    # No place on the machine that trained.
    assert not any(
        b"/else" in content or b"/some" in content for content in files_below(folder).values()
    )
    # The command repeats the training: all that is in the configuration comes back.
    program, command, *words = shlex.split(card["training"]["command"])
    assert program == "sb3-roles"
    given = vars(make_parser().parse_args([command, *words]))
    _, (job,) = new_jobs({k: v for k, v in given.items() if k in GIVEN and v is not None})
    assert job["config"] == read_run_config(runs / "mappo_3")
    assert (job["options"]["num_threads"], job["options"]["eval_freq"]) == (1, 5000)
    # The figure of the training reads it like a run.
    assert read_training_log(folder).steps.tolist() == [6400, 9600]


def actions_of(folder: Path) -> np.ndarray:
    from sb3_roles.evaluation.episodes import run_episodes

    controller = load_run(folder, device="cpu").controller(False, True)
    return run_episodes(controller, "hard", 2, 7, n_agents=3).distance


def test_float32_keeps_every_bit_that_acts(runs, tell):
    for row, folder in (("mappo", runs / "mappo_3"), ("ecc", runs / "ecc_0")):
        assert tell("publish", "--runs", f"{row}={folder}", "-o", row, "--dtype", "float32")[0] == 0
        (small,) = Path(row, row).iterdir()
        one, other = (
            load_run(path, device="cpu").controller(False, True) for path in (folder, small)
        )
        # So their records are the same files, too.
        assert one.description == other.description
        assert np.array_equal(actions_of(folder), actions_of(small))
        (path,) = (small / "checkpoints").iterdir()
        assert path.stat().st_size < 0.7 * (folder / "best" / "model.ckpt").stat().st_size
        assert not any("value" in name for name in read_checkpoint(path).policy)


def test_float16_is_the_nearest_one(runs, tell):
    assert tell("publish", "--runs", f"mappo={runs}/mappo_3", "-o", "out")[0] == 0
    folder = Path("out", "mappo", "seed_3")
    assert read_card(folder)["weights"]["dtype"] == "float16"
    wanted = actor_weights(load_run(runs / "mappo_3", device="cpu").model.policy)
    found = actor_weights(load_run(folder, device="cpu").model.policy)
    assert list(found) == list(wanted)
    for name, tensor in found.items():
        assert tensor.dtype == th.float32
        assert th.equal(tensor, wanted[name].half().float())
    # Where little is saved, nothing is rounded.
    assert tell("publish", "--runs", f"ecc={runs}/ecc_0", "-o", "out")[0] == 0
    assert read_card(Path("out", "ecc", "seed_0"))["weights"]["dtype"] == "float32"
    for tensor in (th.tensor([1e6]), th.tensor([float("nan")])):
        with pytest.raises(CheckpointError, match="weights x"):
            stored({"x": tensor}, "float16")


def test_the_best_weights_are_those_of_their_step(runs, tell):
    code, *_ = tell("publish", "--runs", f"mappo={runs}/mappo_3", "-o", "out", "--load-best")
    assert code == 0
    card = read_card(Path("out", "mappo", "seed_3"))
    assert (card["env_steps"], card["chosen"]) == (5000, "best")


@pytest.mark.parametrize("algo", ["hmappo", "mappo", "ecc", "gnn", "h2gnn"])
def test_no_policy_acts_by_its_critics(algo):
    settings: dict[str, Any] = {"n_timesteps": 8, "n_envs": 1}
    if algo != "gnn":
        settings |= {"n_steps": 4, "batch_size": 4}
    policy = next(iter(ALGORITHMS[algo].policies))
    settings["env_kwargs"] = {"horizon": 5, "known_map": "GNN" in policy}
    config = resolve(algo, "area-search-v0", settings)
    model = make_model(config, make_env(config), "cpu")
    from sb3_roles.evaluation.episodes import run_episodes
    from sb3_roles.evaluation.policies import PolicyController

    def played() -> tuple[np.ndarray, dict[str, Any]]:
        controller = PolicyController(model, deterministic=False)
        return run_episodes(controller, "hard", 2, 7).distance, controller.description

    before = played()
    kept = actor_weights(model.policy)
    critics = [t for name, t in model.policy.state_dict().items() if name not in kept]
    assert critics
    for tensor in critics:
        tensor.fill_(float("nan"))
    after = played()
    assert np.array_equal(before[0], after[0])
    assert before[1] == after[1]
    next(iter(kept.values())).add_(0.5)
    assert played()[1] != before[1]


def test_other_weights_are_not_replaced_silently(runs, tell, tmp_path):
    make_run(tmp_path / "less", "mappo", 3, env_steps=100)
    args = ("publish", "-o", "out", "--runs")
    assert tell(*args, f"mappo={runs}/mappo_3")[0] == 0
    before = files_below(Path("out"))
    # With a run that could be published.
    code, printed, error = tell(*args, "mappo=less", "--runs", f"ecc={runs}/ecc_0")
    assert (code, printed, error.count("\n")) == (2, "", 1)
    assert "9,600 joint steps, cover 69.1 %" in error
    assert "not float16 weights of 100 joint steps" in error
    assert "--replace" in error
    assert files_below(Path("out")) == before
    assert os.listdir("out") == ["mappo"]
    # The same ones are no others.
    assert tell(*args, f"mappo={runs}/mappo_3")[0] == 0
    assert tell(*args, "mappo=less", "--replace")[0] == 0
    assert read_card(Path("out", "mappo", "seed_3"))["env_steps"] == 100
    assert os.listdir(Path("out", "mappo")) == ["seed_3"]


def test_a_failure_leaves_what_was_there(runs, tell, tmp_path, monkeypatch):
    assert tell("publish", "-o", "out", "--runs", f"mappo={runs}/mappo_3")[0] == 0
    before = files_below(Path("out"))
    make_run(tmp_path / "more", "mappo", 3, env_steps=9900)
    rename = os.rename

    def fails(source: Path, target: Path) -> None:
        if ".old" not in str(source) and ".old" not in str(target):
            raise OSError(28, "No space left on device", str(target))
        rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(staging.os, "rename", fails)
        code, _, error = tell("publish", "-o", "out", "--runs", "mappo=more", "--replace")
    assert (code, error.count("\n")) == (2, 1)
    assert "No space left" in error
    assert files_below(Path("out")) == before
    # What a killed writer leaves is no weights, and goes when it is old.
    partial = Path("out", "mappo", ".seed_3.7-ab.partial")
    shutil.copytree(Path("out", "mappo", "seed_3"), partial)
    os.utime(partial, (1e9, 1e9))
    assert tell("publish", "-o", "out", "--runs", "mappo=more", "--replace")[0] == 0
    assert os.listdir(Path("out", "mappo")) == ["seed_3"]


WRONG = [
    ([], "give --runs ROW=RUN to publish runs, or --scores"),
    (["--runs", "mapo=RUNS/mappo_3"], "did you mean 'mappo'?"),
    (["--runs", "mappo"], "must be ROW=RUN"),
    (["--runs", "mappo=nowhere"], "nowhere: no such run folder"),
    (["--runs", "mappo=RUNS/ecc_0"], "is a run of ecc, the row mappo is of mappo"),
    (
        ["--runs", "ecc_coverage=RUNS/ecc_0"],
        "its configuration is not that of the row ecc_coverage",
    ),
    (["--runs", "mappo=empty"], "no checkpoint"),
    (["--runs", "mappo=damaged"], "progress.csv: damaged"),
    (["--runs", "mappo=RUNS/mappo_3", "--dtype", "bfloat"], "allowed are auto, float16, float32"),
    (["--scores"], "no published weights in 'out'"),
]


@pytest.mark.parametrize(("args", "part"), WRONG)
def test_wrong_command_lines(args, part, runs, tell, tmp_path):
    for name in ("empty", "damaged"):
        shutil.copytree(runs / "mappo_3", name)
    shutil.rmtree("empty/checkpoints")
    Path("damaged/progress.csv").write_text("time/env_steps,time/time_elapsed\n1\n")
    code, printed, error = tell(
        "publish", "-o", "out", *[arg.replace("RUNS", str(runs)) for arg in args]
    )
    assert (code, printed) == (2, "")
    assert part in error
    assert error.count("\n") == 1
    assert not Path("out").exists()


# Scores


def small_plan(folder: Path) -> Path:
    """A plan of a few episodes, in which a row of the paper's plays."""
    table = {
        "caption": "Two scenes",
        "n_agents": [2],
        "scenes": {"easy": "Easy", "hard": "Hard"},
        "metrics": ["explo_true", "cover"],
        "rows": ["ecc"],
    }
    plan = {
        "episodes": 4,
        "quick_episodes": 2,
        "seed": 1000,
        "rows": {"ecc": {"label": "ECC", "algo": "ecc", "drawn": True, "block": 2}},
        "tables": {"I": table},
        "figures": {},
    }
    path = folder / "plan.yml"
    path.write_text(yaml.safe_dump(plan))
    return path


def test_scores_come_from_the_records_of_the_weights(runs, tell, tmp_path):
    plan = small_plan(tmp_path)
    publish = ("publish", "-o", "out", "--plan", plan)
    assert tell(*publish, "--runs", f"ecc={runs}/ecc_0")[0] == 0
    folder = Path("out", "ecc", "seed_0")
    assert read_card(folder)["scores"] is None
    tables = ("tables", "--plan", plan, "--jobs", "1", "--runs", f"ecc={folder}")
    assert tell(*tables, "--scenes", "easy")[0] == 0
    assert tell(*tables, "--scenes", "hard", "--episodes", "2")[0] == 0
    # Of hard, not all episodes of the plan were played.
    assert "scores of 1 cells" in tell(*publish, "--scores")[1]
    scores = read_card(folder)["scores"]
    assert (scores["stream"], scores["seed"]) == ("held_out", 1000)
    (cell,) = scores["cells"]
    found = dict(zip(scores["columns"], cell, strict=True))
    assert (found["scene"], found["n_agents"], found["episodes"]) == ("easy", 2, 4)
    paths = sorted(Path("results", "records", "ecc", "easy-2").rglob("*.parquet"))
    values = np.concatenate([read_records(path).curves["cover"][:, -1] for path in paths])
    assert found["cover"] == pytest.approx(100 * values.mean(), abs=1e-3)
    assert found["cover_low"] < found["cover"] < found["cover_high"]
    if len(paths) == 1:
        assert found["t90_true"] == summarize(read_records(paths[0]))["t90_true"]["mean"]
    assert (folder / CARD).read_text() == render(read_card(folder))
    check_files(folder, read_card(folder))
    # Fewer episodes of a cell are not taken for more; what is new is added.
    assert "scores of 2 cells" in tell(*publish, "--scores", "--episodes", "2")[1]
    assert [cell[:3] for cell in read_card(folder)["scores"]["cells"]] == [
        ["easy", 2, 4],
        ["hard", 2, 2],
    ]
    # Publishing the same weights again loses nothing, without records either.
    before = files_below(Path("out"))
    args = ("--runs", f"ecc={runs}/ecc_0", "--records", "nowhere")
    assert tell(*publish, *args)[0] == 0
    after = files_below(Path("out"))
    assert (
        read_card(folder)["scores"]["cells"]
        == yaml.safe_load(before["ecc/seed_0/README.md"].decode().split("---\n")[1])["scores"][
            "cells"
        ]
    )
    assert {name: after[name] for name in after if CARD not in name} == {
        name: before[name] for name in before if CARD not in name
    }
    # Other weights have no scores of these.
    make_run(tmp_path / "other", "ecc", 0, env_steps=9900)
    assert tell(*publish, "--runs", "ecc=other", "--replace")[0] == 0
    assert read_card(folder)["scores"] is None


def test_scores_of_another_stream_are_not_mixed():
    old = {"stream": "held_out", "seed": 1, "columns": ["a"], "cells": [["easy", 2, 9]]}
    new = {**old, "seed": 2, "cells": [["hard", 2, 5]]}
    assert merged(old, new) == new
    assert merged(old, None) == old
    assert merged(None, None) is None
    assert merged(old, {**old, "cells": [["easy", 2, 3]]}) == old


def test_logs_are_thinned_evenly_to_their_end():
    table = [{"x": str(k)} for k in range(1, 21)]
    assert [int(line["x"]) for line in thinned(table, 5)] == [4, 8, 12, 16, 20]
    assert thinned(table, 20) == table
    assert thinned([], 5) == []


def test_a_published_run_can_not_be_resumed(runs, tell):
    assert tell("publish", "--runs", f"ecc={runs}/ecc_0", "-o", "out")[0] == 0
    folder = Path("out", "ecc", "seed_0")
    assert CheckpointFolder(folder / "checkpoints").newest()[1].state == {}
    code, _, error = tell("train", "--resume", folder)
    assert (code, error.count("\n")) == (2, 1)
