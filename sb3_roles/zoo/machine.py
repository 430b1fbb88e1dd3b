"""What a measurement runs on, and measurements in fresh processes."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib.metadata import version
from typing import Any

from sb3_roles._version import __version__
from sb3_roles.zoo.launcher import prepare_process, process_settings
from sb3_roles.zoo.options import UsageError

# Read by torch and what is below it when they are loaded.
_VARIABLES = (
    "OMP_NUM_THREADS",
    "OMP_WAIT_POLICY",
    "MKL_NUM_THREADS",
    "GLIBC_TUNABLES",
    "MALLOC_ARENA_MAX",
    "LD_PRELOAD",
)


def usable_cores() -> int:
    """Return how many CPUs this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def describe_machine() -> dict[str, Any]:
    """Describe what the measurement runs on; call it before the work, for the load average.

    :return: CPU, cores, load average of the last minute, versions
    """
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            names = [
                line.split(":", 1)[1].strip() for line in file if line.startswith("model name")
            ]
        cpu = names[0] if names else cpu
    except OSError:
        pass  # not Linux
    return {
        "cpu": cpu,
        "cores": os.cpu_count(),
        "usable_cores": usable_cores(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "numpy": version("numpy"),
        "numba": version("numba"),
        "sb3_roles": __version__,
    }


def start_torch(num_threads: int | None) -> dict[str, Any]:
    """Import torch with the settings of ``train.py``, and describe the machine.

    :param num_threads: threads of torch; None for its default
    :return: see :func:`describe_machine`; also torch, and the settings of its threads
    """
    machine = describe_machine()
    prepare_process()
    import stable_baselines3
    import torch as th

    from sb3_roles.common.torch_layers import has_fast_bfloat16

    if num_threads is not None:
        th.set_num_threads(num_threads)
    return {
        **machine,
        "torch": th.__version__,
        "stable_baselines3": stable_baselines3.__version__,
        "torch_threads": th.get_num_threads(),
        "cpu_capability": th.backends.cpu.get_cpu_capability(),
        "fast_bfloat16": has_fast_bfloat16(),
        "process": process_settings(),
        "environment": {name: os.environ[name] for name in _VARIABLES if name in os.environ},
    }


def fresh_python(code: str, **variables: str) -> list[float]:
    """Run code in a new interpreter.

    :param code: prints numbers
    :param variables: environment variables to set
    :return: the printed numbers
    :raises UsageError: if it fails
    """
    # The same packages as here, however this process was told where they are.
    path = os.pathsep.join(entry or os.getcwd() for entry in sys.path)
    result = subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": path, **variables},
        capture_output=True,
        text=True,
    )
    if result.returncode != 0:
        reason = result.stderr.strip().splitlines() or [f"exit code {result.returncode}"]
        raise UsageError(f"a fresh interpreter could not run the environment: {reason[-1]}")
    return [float(line) for line in result.stdout.split()]
