"""The proof that the tests pass again and again: on small suites of its own."""

from __future__ import annotations

import os

import pytest

from sb3_roles.prove import suite
from sb3_roles.prove.promises import PROMISES, Setting
from sb3_roles.prove.suite import busy_processes, read_report, start_tests

FLAKY = """
from itertools import count
from pathlib import Path

def test_sound():
    assert True

def test_not_the_second_time():
    for number in count(1):
        try:
            Path(__file__).with_name(f"mark{number}").touch(exist_ok=False)
        except FileExistsError:
            continue
        break
    assert number != 2
"""


def run_tests(tests, report):
    return read_report(report, start_tests(tests, report).wait())


def test_failures_are_named(tmp_path):
    (tmp_path / "test_flaky.py").write_text(FLAKY)
    first, second = (run_tests(tmp_path, tmp_path / f"{i}.xml") for i in range(2))
    assert first.sound
    assert first.passed == 2
    assert not second.sound
    assert (second.passed, second.exit_code) == (1, 1)
    (name,) = second.failed
    assert name.endswith("::test_not_the_second_time")


def test_nothing_to_run_is_no_success(tmp_path):
    (tmp_path / "test_none.py").write_text("")
    assert not run_tests(tmp_path, tmp_path / "none.xml").sound
    (tmp_path / "test_broken.py").write_text("import no_such_module")
    broken = run_tests(tmp_path / "test_broken.py", tmp_path / "broken.xml")
    assert not broken.sound


def test_busy_processes_are_gone_afterwards():
    def children():
        folder = f"/proc/{os.getpid()}/task/{os.getpid()}/children"
        with open(folder) as file:
            return set(file.read().split())

    if not os.path.isdir("/proc/self/task"):
        pytest.skip("no /proc")
    before = children()
    with busy_processes(2):
        assert len(children() - before) == 2
    assert children() <= before


def test_promise_repeats_and_reports_what_failed(tmp_path, monkeypatch):
    folder = tmp_path / "project" / "tests"
    folder.mkdir(parents=True)
    (folder / "test_flaky.py").write_text(FLAKY)
    monkeypatch.setattr(suite, "_ROOT", tmp_path / "project")
    monkeypatch.setattr(suite, "_TIMES", 3)
    outcome = PROMISES["R17"].prove(Setting(False, tmp_path, 0))
    assert (outcome.held, outcome.tried) == (2, 3)
    (failure,) = outcome.failures
    # Runs one and two are side by side.
    assert failure.startswith(("run 1: 1 failed: ", "run 2: 1 failed: "))
    assert failure.endswith("test_not_the_second_time")
    monkeypatch.setattr(suite, "_ROOT", tmp_path)
    assert "source tree" in PROMISES["R17"].prove(Setting(False, tmp_path, 0)).skipped
