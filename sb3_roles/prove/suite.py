"""R17: the project's own tests, again and again, while other processes want the same cores."""

from __future__ import annotations

import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from sb3_roles.prove.processes import environment
from sb3_roles.prove.promises import Outcome, Setting
from sb3_roles.zoo.machine import usable_cores

_ROOT = Path(__file__).resolve().parents[2]
_TIMES = 5
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
    """Run the tests five times beside a busy process for each core.

    :param setting: how
    """
    tests = _ROOT / "tests"
    missing = [name for name in ("pytest", "xdist") if find_spec(name) is None]
    if missing:
        return Outcome(0, 0, "", skipped=f"install {missing[0]}, of sb3_roles[test]")
    if not tests.is_dir():
        return Outcome(0, 0, "", skipped="the tests are in the source tree only")
    n_busy = usable_cores()
    runs: list[SuiteRun] = []
    failures: list[str] = []
    with busy_processes(n_busy):
        for number in range(1, _TIMES + 1):
            one = run_tests(tests, setting.folder / f"{number}.xml", "-n", "auto")
            setting.note(f"run {number}: {one.passed} passed, {len(one.failed)} failed")
            runs.append(one)
            if not one.sound:
                named = ", ".join(one.failed[:_NAMED]) or f"exit code {one.exit_code}"
                failures.append(f"run {number}: {len(one.failed)} failed: {named}")
    held = sum(one.sound for one in runs)
    n_tests = min(one.passed for one in runs)
    said = f"runs of {n_tests:,} tests beside {n_busy} busy processes without a failure"
    return Outcome(held, len(runs), said, tuple(failures))


@contextmanager
def busy_processes(number: int) -> Iterator[None]:
    """Keep cores busy.

    :param number: processes that do nothing but want to run
    """
    processes = [subprocess.Popen([sys.executable, "-c", _BUSY]) for _ in range(number)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


def run_tests(tests: Path, report: Path, *options: str) -> SuiteRun:
    """Run pytest in a process of its own.

    :param tests: file or folder
    :param report: file for its JUnit report
    :param options: of pytest
    """
    words = [sys.executable, "-m", "pytest", "-q", f"--junitxml={report}", *options, str(tests)]
    result = subprocess.run(
        words, cwd=_ROOT, env=environment(), stdin=subprocess.DEVNULL, capture_output=True
    )
    if not report.is_file():
        return SuiteRun(0, (), result.returncode)
    cases = list(ElementTree.parse(report).getroot().iter("testcase"))
    failed = [one for one in cases if one.find("failure") is not None or _has_error(one)]
    skipped = [one for one in cases if one.find("skipped") is not None]
    names = tuple(f"{one.get('classname')}::{one.get('name')}" for one in failed)
    return SuiteRun(len(cases) - len(failed) - len(skipped), names, result.returncode)


def _has_error(case: ElementTree.Element) -> bool:
    return case.find("error") is not None
