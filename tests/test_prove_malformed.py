"""The experiment on malformed commands notices what it looks for."""

from __future__ import annotations

import tempfile
from collections import Counter

import pytest

from sb3_roles.prove import malformed
from sb3_roles.prove.malformed import NONSENSE, Seen, attempt, in_this_process, stock_end
from sb3_roles.prove.malformed_cases import CASES, COMMAND_LINES, Case
from sb3_roles.prove.promises import Setting
from sb3_roles.zoo import train
from sb3_roles.zoo.cli import COMMANDS
from sb3_roles.zoo.options import UsageError

CASE = Case(("train.py", "--algo", "hmapo"), ("did you mean 'hmappo'?",))
GOOD = Seen(2, "", "train.py: error: did you mean 'hmappo'?\n", 0.4)


def test_there_are_enough_cases_of_every_command():
    assert len(CASES) >= 60
    assert len({(case.words, tuple(case.files.items())) for case in CASES}) == len(CASES)
    assert all(case.named and case.name.isprintable() for case in CASES)
    commands = {command.rpartition(".")[2] for command in COMMANDS} - {"command"}
    first = Counter(case.words[0].removesuffix(".py") for case in COMMAND_LINES)
    assert set(first) >= commands | {"prove", "report"}


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({}, None),
        ({"code": 1}, "exit code 1"),
        ({"code": 0, "err": ""}, "0 lines"),
        ({"err": "Traceback:\n" + GOOD.err}, "2 lines"),
        ({"err": "train.py: error: no\n"}, "not named"),
        ({"err": GOOD.err.replace("did", "\x1b[31mdid")}, "printable"),
        ({"err": GOOD.err.replace("did", "x" * 3000 + "did")}, "short"),
        ({"out": "training"}, "printed"),
        ({"seconds": 1.1}, "1.10 s of CPU"),
        ({"heavy": ("torch",)}, "imported torch"),
    ],
)
def test_what_is_wrong_with_an_end(changes, found):
    problems = malformed.problems(CASE, GOOD._replace(**changes), {}, {})
    assert (problems == []) if found is None else any(found in one for one in problems)


def test_what_is_left_behind_is_seen(tmp_path, monkeypatch):
    assert attempt(CASE, tmp_path / "good", in_this_process)[0] == []

    def run(args):
        (tmp_path / "bad" / "logs").mkdir()
        raise UsageError("did you mean 'hmappo'?")

    monkeypatch.setattr(train, "run", run)
    case = Case(("train.py",), CASE.named)
    (problem,) = attempt(case, tmp_path / "bad", in_this_process)[0]
    assert "logs" in problem


def test_a_child_reports_what_it_has_imported(tmp_path):
    assert attempt(CASE, tmp_path / "good", malformed.in_a_process)[0] == []
    child = "import torch\n" + malformed._CHILD
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(malformed, "_CHILD", child)
        problems = attempt(CASE, tmp_path / "bad", malformed.in_a_process)[0]
    assert any("imported torch" in one for one in problems)


def test_the_experiment_tells_which_case_failed(tmp_path, monkeypatch):
    wrong = Case(("prove", "R99"), ("did you mean 'R0'?",))
    monkeypatch.setattr(malformed, "CASES", (CASE, wrong))
    monkeypatch.setattr(malformed, "_QUICK_PROCESSES", 2)
    monkeypatch.setattr(malformed, "in_a_process", in_this_process)
    monkeypatch.setattr(malformed, "NONSENSE", {"gamma": 1.5, "n_steps": 16})
    monkeypatch.setattr(malformed, "_stock", lambda: "")
    outcome = malformed.commands(Setting(True, tmp_path, 0))
    assert not outcome.kept
    assert any("R99" in one and "not named" in one for one in outcome.failures)
    assert any("n_steps: nonsense" in one for one in outcome.failures)


def test_how_the_stock_algorithm_takes_nonsense(monkeypatch, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    assert len(NONSENSE) == 13
    assert stock_end("gamma", 1.5) == "trained"
    assert stock_end("batch_size", 0) == "named"
    assert stock_end("n_steps", 16) == "trained"
    assert not list(tmp_path.glob("SB3-*"))
