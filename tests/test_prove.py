"""The command that tries what is promised, and the short form of every promise."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
import torch

from sb3_roles.prove import promises
from sb3_roles.prove.command import line
from sb3_roles.prove.promises import PROMISES, Outcome, Promise, Setting
from sb3_roles.zoo.cli import main

QUICK = [name for name, promise in PROMISES.items() if promise.has_quick]


@pytest.mark.parametrize("name", QUICK)
def test_a_promise_is_kept_in_its_short_form(name, tmp_path):
    outcome = PROMISES[name].prove(Setting(True, tmp_path, 0))
    if outcome.skipped:
        pytest.skip(outcome.skipped)
    assert outcome.kept, outcome
    assert outcome.said


def test_promises_are_numbered_and_point_to_experiments():
    assert list(PROMISES) == [f"R{i}" for i in range(1, 18)]
    assert [f"R{i}" for i in range(1, 16)] == QUICK


def replaced(monkeypatch, outcomes):
    """Let promises have these outcomes; return the settings that they are tried with."""
    seen = []

    def prove(self, setting):
        seen.append((self.name, setting))
        assert setting.folder.is_dir()
        (setting.folder / "file").write_text("x")
        outcome = outcomes[self.name]
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    monkeypatch.setattr(promises.Promise, "prove", prove)
    return seen


def test_command_prints_a_line_each_and_writes_a_table(monkeypatch, tmp_path, capsys):
    outcomes = {
        "R1": Outcome(20, 20, "kills survived, identical", stock="no resume"),
        "R3": Outcome(9, 10, "a|b", ("trial 4: both are damaged",)),
        "R14": Outcome(0, 0, "", skipped="install sb3_roles[ray]"),
    }
    seen = replaced(monkeypatch, outcomes)
    table = tmp_path / "table.md"
    arguments = ["prove", "R1", "R3", "R14", "--seed", "5", "-o", str(table)]
    assert main(arguments) == 1
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("R1 20/20 kills survived, identical; stock: no resume (")
    assert printed[1].startswith("R3 BROKEN: 9/10 a|b (")
    assert printed[2:] == [
        "    trial 4: both are damaged",
        "R14 not tried: install sb3_roles[ray]",
    ]
    text = table.read_text()
    assert "| R3 | " in text
    assert "**broken**: 9/10 a\\|b" in text
    assert "* R3: trial 4: both are damaged" in text
    assert "full forms" in text
    assert [(name, setting.quick, setting.seed) for name, setting in seen] == [
        (name, False, 5) for name in ("R1", "R3", "R14")
    ]
    assert not any(setting.folder.exists() for _, setting in seen)


def test_exit_code_says_whether_all_were_kept(monkeypatch):
    kept = dict.fromkeys(PROMISES, Outcome(1, 1, "kept"))
    seen = replaced(monkeypatch, kept)
    assert main(["prove"]) == 0
    assert [name for name, _ in seen] == list(PROMISES)
    seen.clear()
    assert main(["prove", "--quick"]) == 0
    assert [name for name, _ in seen] == QUICK
    kept["R2"] = Outcome(0, 0, "nothing was tried")
    assert main(["prove", "R2"]) == 1


def test_an_interruption_keeps_the_table_of_what_was_tried(monkeypatch, tmp_path, capsys):
    outcomes = {"R1": Outcome(2, 2, "kept"), "R2": KeyboardInterrupt()}
    seen = replaced(monkeypatch, outcomes)
    table = tmp_path / "table.md"
    assert main(["prove", "R1", "R2", "-o", str(table)]) == 130
    assert capsys.readouterr().err == "R2: stopped\n"
    text = table.read_text()
    assert "| R1 | " in text
    assert f"torch {torch.__version__.partition('+')[0]}" in text
    assert not any(setting.folder.exists() for _, setting in seen)


def test_an_experiment_that_fails_is_broken_and_the_others_are_tried(monkeypatch, capsys):
    outcomes = {"R1": TimeoutError("no save\nin 300 s"), "R3": Outcome(2, 2, "kept")}
    seen = replaced(monkeypatch, outcomes)
    assert main(["prove", "R1", "R3"]) == 1
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("R1 BROKEN: 0/0 the experiment failed (")
    assert printed[1] == "    TimeoutError: no save in 300 s"
    assert printed[2].startswith("R3 2/2 kept (")
    assert not any(setting.folder.exists() for _, setting in seen)


def test_sigterm_ends_an_experiment_as_ctrl_c_does(monkeypatch):
    seen = []

    def prove(self, setting):
        seen.append(setting.folder)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(promises.Promise, "prove", prove)
    assert main(["prove", "R1", "R2"]) == 143
    assert [folder.exists() for folder in seen] == [False]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["R18"], ["'R18'", "R1"]),
        (["r7"], ["unknown promise 'r7'", "did you mean 'R7'"]),
        (["R16", "--quick"], ["R16 has no short form"]),
        (["--seed", "-1"], ["from 0 to"]),
        (["-o", "table.txt"], [".md"]),
        (["-o", f"{__file__}/table.md"], ["is no folder"]),
        (["-o", "locked/table.md"], ["'locked' can not be written"]),
    ],
)
def test_command_refuses(arguments, words, capsys, monkeypatch, tmp_path):
    # Rights do not keep root out.
    monkeypatch.chdir(tmp_path)
    Path("locked").mkdir()
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path).name != "locked")
    with pytest.raises(SystemExit) as stop:
        main(["prove", *arguments])
    assert stop.value.code == 2
    (only,) = capsys.readouterr().err.splitlines()
    assert all(word in only for word in words)


def test_line_of_a_promise():
    promise = Promise("R1", "text", "target", "module:function")
    assert line(promise, Outcome(3, 3, "kept"), 2.4) == "R1 3/3 kept (2 s)"
    assert not Outcome(0, 0, "").kept
    assert not Outcome(3, 3, "", ("odd",)).kept
