"""R17: the project's own tests, again and again, while other processes want the same cores."""

from __future__ import annotations

import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from sb3_roles.prove.processes import environment
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.zoo.machine import usable_cores

_ROOT = Path(__file__).resolve().parents[2]
_TIMES, _AT_ONCE = 5, 2
_POLL = 0.5
# Until this process is gone, however it ends.
_BUSY = "import os; parent = os.getppid()\nwhile os.getppid() == parent: pass"
# Names that are printed of the failures of one run.
_NAMED = 5


@dataclass(frozen=True)
class SuiteRun:
    """One run of the tests.

    :param passed: number of tests
    :param failed: names of those that failed, or could not be run
    :param exit_code: pytest's
    """

    passed: int
    failed: tuple[str, ...]
    exit_code: int

    @property
    def sound(self) -> bool:
        """Whether tests were run, and all of them passed."""
        return self.exit_code == 0 and self.passed > 0 and not self.failed


def repeats(setting: Setting) -> Outcome:
    """Run the tests five times, two at a time; beside the last one every core is kept busy.

    Each is the other's load, and neither has files, ports or locks for itself.

    :param setting: how
    """
    tests = _ROOT / "tests"
    missing = [name for name in ("pytest", "xdist") if find_spec(name) is None]
    if missing:
        return Outcome(0, 0, "", skipped=f"install {missing[0]}, of sb3_roles[test]")
    if not tests.is_dir():
        return Outcome(0, 0, "", skipped="the tests are in the source tree only")
    runs: list[SuiteRun] = []
    failures: list[str] = []
    for number, one in side_by_side(tests, setting.folder):
        setting.note(f"run {number}: {one.passed} passed, {len(one.failed)} failed")
        runs.append(one)
        if not one.sound:
            named = ", ".join(one.failed[:_NAMED]) or f"exit code {one.exit_code}"
            failures.append(f"run {number}: {len(one.failed)} failed: {named}")
    held = sum(one.sound for one in runs)
    n_tests = min(one.passed for one in runs)
    said = f"runs of {n_tests:,} tests, {_AT_ONCE} at a time, without a failure"
    return Outcome(held, len(runs), said, tuple(failures))


def side_by_side(tests: Path, folder: Path) -> Iterator[tuple[int, SuiteRun]]:
    """Run the tests, and busy processes where fewer than two runs are left.

    :param tests: folder
    :param folder: for reports
    :return: number and outcome of each run, as they end
    """
    waiting, running = list(range(1, _TIMES + 1)), dict[int, subprocess.Popen[bytes]]()
    with ExitStack() as stack:
        stack.callback(lambda: _end(running.values()))
        while waiting or running:
            while waiting and len(running) < _AT_ONCE:
                number = waiting.pop(0)
                running[number] = start_tests(tests, folder / f"{number}.xml", "-n", "auto")
            ended = [number for number, process in running.items() if process.poll() is not None]
            for number in ended:
                code = running.pop(number).returncode
                if not waiting and len(running) == _AT_ONCE - 1:
                    stack.enter_context(busy_processes(usable_cores()))
                yield number, read_report(folder / f"{number}.xml", code)
            time.sleep(_POLL)


@contextmanager
def busy_processes(number: int) -> Iterator[None]:
    """Keep cores busy.

    :param number: processes that do nothing but want to run
    """
    processes = [subprocess.Popen([sys.executable, "-c", _BUSY]) for _ in range(number)]
    try:
        yield
    finally:
        _end(processes)


def _end(processes: Collection[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        process.kill()
    for process in processes:
        process.wait()


def start_tests(tests: Path, report: Path, *options: str) -> subprocess.Popen[bytes]:
    """Start pytest in a process of its own.

    :param tests: file or folder
    :param report: file for its JUnit report
    :param options: of pytest
    """
    words = [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *options, str(tests)]
    nothing = subprocess.DEVNULL
    return subprocess.Popen(
        words, cwd=_ROOT, env=environment(), stdin=nothing, stdout=nothing, stderr=nothing
    )


def read_report(report: Path, exit_code: int) -> SuiteRun:
    """Return what came out of a process of :func:`start_tests` that has ended.

    :param report: its JUnit report, which is missing if it ended early
    :param exit_code: pytest's
    """
    if not report.is_file():
        return SuiteRun(0, (), exit_code)
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    failed = [one for one in cases if one.find("failure") is not None or _has_error(one)]
    skipped = [one for one in cases if one.find("skipped") is not None]
    names = tuple(f"{one.get('classname')}::{one.get('name')}" for one in failed)
    return SuiteRun(len(cases) - len(failed) - len(skipped), names, exit_code)


def _has_error(case: ElementTree.Element) -> bool:
    return case.find("error") is not None
