"""What the rounding of a computation depends on: versions, the processor, and settings of both."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_roles._version import __version__
from sb3_roles.common.torch_layers import resolve_precision
from sb3_roles.common.versions import PACKAGES, version_of

# Which kernels are taken, and how work is divided among threads. Others, such as OMP_NUM_THREADS,
# act through what is noted anyway, and OMP_WAIT_POLICY on the time only.
VARIABLES = (
    "ATEN_CPU_CAPABILITY",
    "CUBLAS_WORKSPACE_CONFIG",
    "DNNL_DEFAULT_FPMATH_MODE",
    "DNNL_MAX_CPU_ISA",
    "MKL_CBWR",
    "MKL_DYNAMIC",
    "MKL_ENABLE_INSTRUCTIONS",
    "MKL_NUM_THREADS",
    "NVIDIA_TF32_OVERRIDE",
    "OMP_DYNAMIC",
    "OMP_THREAD_LIMIT",
    "ONEDNN_DEFAULT_FPMATH_MODE",
    "ONEDNN_MAX_CPU_ISA",
)


def processor() -> str:
    """Return the kind of this processor, with the caches that blocks of products are cut for."""
    known: dict[str, Any] = getattr(th.cpu, "get_capabilities", dict)()
    name = known.get("cpu_name") or platform.processor() or platform.machine()
    caches = [
        f"{level} {known[key] // 1024} KiB"
        for level, key in (("L1", "l1d_cache_size"), ("L2", "l2_cache_size"))
        if known.get(key)
    ]
    return " ".join([name, *caches])


def machine_facts(model: BaseAlgorithm) -> dict[str, Any]:
    """Return what bit-exactness depends on beyond a run's own state.

    :param model: the algorithm, for its device and for what a precision of ``"auto"`` comes to
    :return: plain values; variables of the environment are there if they are set
    """
    device = model.device
    precision = getattr(model.policy, "precision", None)
    facts: dict[str, Any] = {
        "sb3_roles": __version__,
        **{name.replace("-", "_"): version_of(name) for name in PACKAGES},
        # With the build, as in 2.13.0+cpu.
        "torch": th.__version__,
        "python": platform.python_version(),
        "device": device.type,
        "threads": th.get_num_threads(),
        "processor": processor(),
        "cpu_capability": th.backends.cpu.get_cpu_capability(),
        "dtype": str(th.get_default_dtype()),
        "precision": None if precision is None else resolve_precision(precision, device),
        "matmul_precision": th.get_float32_matmul_precision(),
        "deterministic": th.are_deterministic_algorithms_enabled(),
    }
    if device.type == "cuda":
        facts["gpu"] = th.cuda.get_device_name(device)
        facts["cuda"] = th.version.cuda
        for name in ("deterministic", "benchmark", "allow_tf32"):
            facts[f"cudnn_{name}"] = getattr(th.backends.cudnn, name)
        facts["cudnn"] = th.backends.cudnn.version()
    return {**facts, **{name: os.environ[name] for name in VARIABLES if name in os.environ}}


def differences(saved: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """Return what keeps a run on another machine from being bit-exact, one text each.

    :param saved: facts of :func:`machine_facts`, or keys of a configuration; nested ones as well
    :param now: the same, as it is
    """
    found = []
    for name in {**saved, **now}:
        one, other = saved.get(name), now.get(name)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            found += [f"{name}: {line}" for line in differences(one, other)]
        elif one != other:
            found.append(f"{name} was {one}, is {other}")
    return found
