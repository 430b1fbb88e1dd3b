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


def seed_arguments(arguments: Sequence[str], seed: int, n_threads: int) -> list[str]:
    """Return the command line of one of the runs.

    :param arguments: of all of them, the command first
    :param seed: of the run
    :param n_threads: of torch
    """
    left, values = [], iter(arguments)
    for text in values:
        name, equals, _ = text.partition("=")
        if name in ("--ray", "--n-seeds", "--seed", "--num-threads"):
            if not equals:
                next(values)
            continue
        left.append(text)
    return [*left, "--seed", str(seed), "--num-threads", str(n_threads)]


def run_on_ray(
    arguments: Sequence[str], seeds: Sequence[int], options: Mapping[str, Any], n_threads: int
) -> int:
    """Train several runs, and print how each has ended, in the order of the seeds.

    A run that is lost with its machine is not begun again: it left a run folder to resume.

    :param arguments: of the command, which is the first one
    :param seeds: of the runs
    :param options: of the command
    :param n_threads: of torch, and CPUs of a run
    :return: the first exit code that is not 0, or 0
    :raises UsageError: if no machine of the cluster has so many CPUs
    """
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    largest = int(max((node.get("CPU", 0) for node in nodes), default=0))
    if n_threads > largest:
        raise UsageError(
            f"--num-threads {n_threads}: no machine of the cluster has so many CPUs, the largest "
            f"has {largest}"
        )
    gpus = 1 if options["device"] == "cuda" else 0
    train = ray.remote(num_cpus=n_threads, num_gpus=gpus, max_retries=0)(train_run)
    running = [
        train.remote(seed_arguments(arguments, seed, n_threads), os.getcwd()) for seed in seeds
    ]
    codes = []
    for seed, run in zip(seeds, running, strict=True):
        try:
            outcome = Outcome(*ray.get(run))
        except ray.exceptions.RayError as error:
            outcome = Outcome(EXIT_LOST, [f"lost: {one_line(error)[:200]}"])
        codes.append(outcome.code)
        print(f"seed {seed}: exit code {outcome.code}", flush=True)
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
