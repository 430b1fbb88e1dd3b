"""``sb3-roles curves``: runs side by side."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sb3_roles.zoo.cli import main


def make_run(
    folder: Path, algo: str, covers: list[float | str], begin: int = 1000, every: int = 1000
) -> str:
    folder.mkdir(parents=True)
    (folder / "config.yml").write_text(f"algo: {algo}\n")
    rows = [f"{begin + every * k},{cover}" for k, cover in enumerate(covers)]
    (folder / "evaluations.csv").write_text("\n".join(["env_steps,cover", *rows]) + "\n")
    return str(folder)


def test_runs_of_an_algorithm_are_averaged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [
        make_run(tmp_path / "a", "hmappo", [0.25, 0.5, 0.7]),
        make_run(tmp_path / "b", "hmappo", [0.35, 0.6]),
        make_run(tmp_path / "c", "mappo", [0.1, 0.2]),
    ]
    assert main(["curves", *runs, "--metrics", "cover", "--every", "1000"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[2] == "| 1,000 | 30.0 % [25.0 .. 35.0] | 10.0 % [10.0 .. 10.0] |"
    assert lines[3].startswith("| 2,000 | 55.0 % ")
    # The third evaluation of one run only is no average.
    assert len(lines) == 4
    assert main(["curves", *runs, "--metrics", "cover", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["hmappo"]["2000"]["cover"] == [0.5, 0.6]


def report_of(capsys: pytest.CaptureFixture[str], *args: str) -> dict[str, Any]:
    assert main(["curves", *args, "--metrics", "cover", "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_runs_shorter_than_a_row_have_their_last_evaluation(tmp_path, capsys):
    run = make_run(tmp_path / "a", "hmappo", [0.1, 0.4])
    assert main(["curves", run, "--metrics", "cover", "--every", "10000"]) == 0
    assert capsys.readouterr().out.splitlines()[2:] == ["| 2,000 | 40.0 % [40.0 .. 40.0] |"]


def test_runs_have_labels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Two settings of one algorithm are told apart, patterns name several runs."""
    for k in (1, 2, 10):
        make_run(tmp_path / "same" / f"x_{k}", "hmappo", [k / 100])
    default = make_run(tmp_path / "default", "hmappo", [0.5])
    (tmp_path / "same" / "notes.txt").write_text("no run")
    pattern = f"one reward={tmp_path}/same/*"
    report = report_of(capsys, pattern, f"ours={default}", default, f"ours={default}/")
    assert report == {
        "one reward": {"1000": {"cover": [0.01, 0.02, 0.1]}},
        "ours": {"1000": {"cover": [0.5]}},
        "hmappo": {"1000": {"cover": [0.5]}},
    }
    # The shell has expanded this one; a folder may be called so.
    odd = make_run(tmp_path / "a=b", "mappo", [0.3])
    assert report_of(capsys, odd) == {"mappo": {"1000": {"cover": [0.3]}}}
    assert main(["curves", f"a|b={default}", "--metrics", "cover", "--every", "1000"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == "| joint steps | a\\|b cover |"


def test_seeds_may_be_evaluated_at_different_steps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = [
        make_run(tmp_path / "a", "hmappo", [0.2, 0.4, 0.8]),
        make_run(tmp_path / "b", "hmappo", [0.0, 0.3], begin=1500, every=1000),
        make_run(tmp_path / "c", "mappo", [0.1, 0.5, 0.6], begin=1200, every=1000),
    ]
    report = report_of(capsys, *runs)
    # While both were trained: a between 0.2, 0.4 and 0.8; b between 0 and 0.3.
    expected = {"1500": [0.3, 0.0], "2000": [0.4, 0.15], "2500": [0.6, 0.3]}
    assert list(report["hmappo"]) == list(expected)
    for step, values in expected.items():
        assert report["hmappo"][step]["cover"] == pytest.approx(values)
    assert list(report["mappo"]) == ["1200", "2200", "3200"]
    assert main(["curves", *runs, "--metrics", "cover", "--every", "1000"]) == 0
    # The rows are the steps at which most labels have a value, none of which is blank there.
    assert capsys.readouterr().out.splitlines()[2:] == [
        "| 1,500 | 15.0 % [0.0 .. 30.0] | 22.0 % [22.0 .. 22.0] |",
        "| 2,000 | 27.5 % [15.0 .. 40.0] | 42.0 % [42.0 .. 42.0] |",
        "| 3,200 | - | 60.0 % [60.0 .. 60.0] |",
    ]


def test_a_value_that_is_missing_is_null(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As ``time_e_paper`` is where a team never gets there."""
    run = make_run(tmp_path / "a", "hmappo", ["", 0.5])
    report = report_of(capsys, run, make_run(tmp_path / "b", "hmappo", [0.25, 0.5]))
    assert report == {"hmappo": {"1000": {"cover": [None, 0.25]}, "2000": {"cover": [0.5, 0.5]}}}
    assert main(["curves", run, "--metrics", "cover", "--every", "1000"]) == 0
    assert capsys.readouterr().out.splitlines()[2] == "| 1,000 | - |"


def test_a_plot_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run = make_run(tmp_path / "a", "hmappo", ["", 0.25, 0.5])
    file = tmp_path / "curves.png"
    assert main(["curves", run, "--metrics", "cover", "--plot", str(file)]) == 0
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("covers", "arguments", "message"),
    [
        ([0.2], ["--metrics", "covr"], "did you mean 'cover'"),
        (["x"], ["--metrics", "cover"], "damaged"),
        ([0.2], ["--every", "0"], "--every"),
        ([], [], "no evaluation yet"),
        ([0.2], ["label="], "LABEL=RUN"),
        ([0.2], ["=x"], "LABEL=RUN"),
        ([0.2], ["label=/no/*/run"], "/no/*/run: no such run folder"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path,
    tell: Callable[..., tuple[int, str, str]],
    covers: list[float | str],
    arguments: list[str],
    message: str,
) -> None:
    run = make_run(tmp_path / "a", "hmappo", covers)
    code, _, error = tell("curves", run, *arguments)
    assert code == 2
    assert message in error
    assert error.count("\n") == 1


def test_a_folder_without_evaluations_is_refused(
    tmp_path: Path, tell: Callable[..., tuple[int, str, str]]
) -> None:
    code, _, error = tell("curves", tmp_path)
    assert (code, "config.yml" in error) == (2, True)
    (tmp_path / "config.yml").write_text("algo: hmappo\n")
    code, _, error = tell("curves", tmp_path)
    assert (code, "--eval-freq" in error) == (2, True)


def test_all_evaluations_of_a_short_run_are_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "a", "hmappo", [0.1, 0.2, 0.3])
    assert main(["curves", run, "--metrics", "cover"]) == 0
    assert [line.split()[1] for line in capsys.readouterr().out.splitlines()[2:]] == [
        "1,000",
        "2,000",
        "3,000",
    ]


def test_an_environment_of_ones_own_has_returns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.yml").write_text("algo: hmappo\n")
    (tmp_path / "evaluations.csv").write_text("env_steps,return\n400,2.5\n800,7.25\n")
    assert main(["curves", str(tmp_path)]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "| joint steps | hmappo return |",
        "|---|---|",
        "| 400 | 2.5 [2.5 .. 2.5] |",
        "| 800 | 7.2 [7.2 .. 7.2] |",
    ]
