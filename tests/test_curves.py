"""``sb3-roles curves``: runs side by side."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from sb3_roles.zoo.cli import main


def make_run(folder: Path, algo: str, covers: list[float | str]) -> str:
    folder.mkdir()
    (folder / "config.yml").write_text(f"algo: {algo}\n")
    rows = [f"{1000 * (k + 1)},{cover}" for k, cover in enumerate(covers)]
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


def test_a_plot_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    run = make_run(tmp_path / "a", "hmappo", [0.25, 0.5])
    file = tmp_path / "curves.png"
    assert main(["curves", run, "--metrics", "cover", "--plot", str(file)]) == 0
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("covers", "arguments", "message"),
    [
        ([0.2], ["--metrics", "covr"], "did you mean 'cover'"),
        (["x"], ["--metrics", "cover"], "damaged"),
        ([0.2], ["--every", "0"], "--every"),
    ],
)
def test_bad_input_is_one_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    covers: list[float | str],
    arguments: list[str],
    message: str,
) -> None:
    run = make_run(tmp_path / "a", "hmappo", covers)
    try:
        code = main(["curves", run, *arguments])
    except SystemExit as stop:
        code = stop.code  # type: ignore[assignment]
    error = capsys.readouterr().err
    assert code == 2
    assert message in error
    assert error.count("\n") == 1


def test_a_folder_without_evaluations_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        raise SystemExit(main(["curves", str(tmp_path / "none")]))
    assert stop.value.code == 2
    assert "evaluations.csv" in capsys.readouterr().err
