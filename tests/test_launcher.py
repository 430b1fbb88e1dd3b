"""What the launcher sets for the process, and what it leaves to the user."""

from __future__ import annotations

import os
import platform
import subprocess
import sys

import pytest

PROGRAM = """
import resource
from sb3_roles.zoo.launcher import prepare_process, process_settings
prepare_process()
prepare_process()
print(process_settings())
import numpy as np
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        np.ones(1_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""
ON_GLIBC = pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="not glibc")


def launch(**variables: str) -> tuple[str, int]:
    own = ("OMP_", "MALLOC_", "GLIBC_")
    clean = {key: value for key, value in os.environ.items() if not key.startswith(own)}
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        env={**clean, **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    settings, faults = done.stdout.splitlines()
    return settings, int(faults)


@ON_GLIBC
def test_freed_memory_is_kept_unless_the_user_has_set_the_allocator():
    settings, kept = launch()
    assert settings == "OMP_WAIT_POLICY=PASSIVE, malloc: keeps freed memory"
    # What glibc does by itself: arrays of 8 MB come from the system and go back to it.
    settings, returned = launch(MALLOC_MMAP_THRESHOLD_="131072")
    assert settings == "OMP_WAIT_POLICY=PASSIVE, malloc: MALLOC_MMAP_THRESHOLD_=131072"
    assert kept < returned / 100


def test_the_wait_policy_of_the_user_stands():
    assert launch(OMP_WAIT_POLICY="ACTIVE")[0].startswith("OMP_WAIT_POLICY=ACTIVE, ")
