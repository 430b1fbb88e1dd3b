"""Runs of ``train`` side by side on a Ray cluster: ``train.py --ray ADDRESS --n-seeds K``."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

from sb3_roles.common.names import one_line
from sb3_roles.common.ray_cluster import ray
from sb3_roles.zoo.options import UsageError

_LAST_LINES = 3
_PR_SET_PDEATHSIG = 1
EXIT_LOST = 1


class Outcome(NamedTuple):
    """How a run ended."""

    code: int
    lines: list[str]
    """the last ones that it printed"""


class RunOf(NamedTuple):
    """What tells one run of a command line from the others."""

    algo: str
    change: str | None
    """``KEY:VALUE`` of the configuration"""
    seed: int

    def __str__(self) -> str:
        change = "" if self.change is None else f"{self.change}, "
        return f"{self.algo}, {change}seed {self.seed}"


# What is said of all runs, and how many values it has there; None for as many as there are.
_OF_ALL = {"--ray": 1, "--n-seeds": 1, "--seed": 1, "--num-threads": 1, "--algo": 1, "--vary": None}


def run_arguments(arguments: Sequence[str], run: RunOf, n_threads: int) -> list[str]:
    """Return the command line of one of the runs.

    :param arguments: of all of them, the command first
    :param run: which one
    :param n_threads: of torch
    """
    left: list[str] = []
    skip: int | None = 0
    for text in arguments:
        name, equals, _ = text.partition("=")
        if name in _OF_ALL:
            skip = _OF_ALL[name]
            if equals and skip is not None:
                skip -= 1
        elif skip != 0 and not (skip is None and text.startswith("-")):
            skip = None if skip is None else skip - 1
        else:
            skip = 0
            left.append(text)
    left += ["--algo", run.algo, "--seed", str(run.seed), "--num-threads", str(n_threads)]
    return left if run.change is None else [*left, "--hyperparams", run.change]


def run_on_ray(
    arguments: Sequence[str], runs: Sequence[RunOf], options: Mapping[str, Any], n_threads: int
) -> int:
    """Train several runs, and print how each has ended, in their order.

    A run that is lost with its machine is not begun again: it left a run folder to resume.

    :param arguments: of the command, which is the first one
    :param runs: the runs
    :param options: of the command
    :param n_threads: of torch, and CPUs of a run
    :return: the first exit code that is not 0, or 0
    :raises UsageError: if no machine of the cluster has so many CPUs, or the GPU
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    largest = int(max((node.get("CPU", 0) for node in nodes), default=0))
    if n_threads > largest:
        raise UsageError(
            f"--num-threads {n_threads}: no machine of the cluster has so many CPUs, the largest "
            f"has {largest}"
        )
    gpus = 1 if options["device"] == "cuda" else 0
    if gpus and not any(node.get("GPU", 0) >= 1 for node in nodes):
        raise UsageError("--device cuda: no machine of the cluster has a GPU")
    train = ray.remote(num_cpus=n_threads, num_gpus=gpus, max_retries=0)(train_run)
    running = [train.remote(run_arguments(arguments, run, n_threads), os.getcwd()) for run in runs]
    codes = []
    for run, sent in zip(runs, running, strict=True):
        try:
            outcome = Outcome(*ray.get(sent))
        except ray.exceptions.RayError as error:
            outcome = Outcome(EXIT_LOST, [f"lost: {one_line(error)[:200]}"])
        codes.append(outcome.code)
        print(f"{run}: exit code {outcome.code}", flush=True)
        for line in outcome.lines:
            print(f"  {line}", flush=True)
    return next((code for code in codes if code), 0)


def train_run(arguments: Sequence[str], folder: str) -> Outcome:
    """Train one run in a process of its own, as a command line would.

    :param arguments: behind ``sb3-roles``
    :param folder: to be in
    """
    command = [sys.executable, "-m", "sb3_roles", *arguments]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
            preexec_fn=_end_with_parent,
        )
    except OSError as error:
        return Outcome(EXIT_LOST, [f"{os.uname().nodename}: {error.strerror}: {folder}"])
    return Outcome(done.returncode, done.stdout.splitlines()[-_LAST_LINES:])


def _end_with_parent() -> None:
    """Let a run whose worker dies stop as after SIGTERM, with a checkpoint; on Linux."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
