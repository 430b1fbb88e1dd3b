"""What a training takes of the memory, and what it would take with Stable-Baselines3's buffer."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gymnasium import spaces

# How many times less than DictRolloutBuffer it shall be; reported, never asserted.
MEMORY_TARGET = 10.0


def peak_memory() -> int | None:
    """Return the most bytes that were resident in this process; None where nobody counts them."""
    if sys.platform == "win32":
        return None
    import resource

    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


def dict_buffer_bytes(space: spaces.Dict, n_steps: int, n_rows: int, float32: bool) -> int:
    """Return the bytes of observations in SB3's ``DictRolloutBuffer``, by making one.

    :param space: of one row
    :param n_steps: steps of a rollout
    :param n_rows: robots of all teams
    :param float32: store everything as float32, as SB3 did before 2.7.1; False for what the
        installed version does
    """
    from gymnasium import spaces
    from stable_baselines3.common.buffers import DictRolloutBuffer

    if float32:
        boxes = [(key, spaces.Box(-1.0, 1.0, box.shape)) for key, box in space.spaces.items()]
        space = spaces.Dict(boxes)
    # Its pages are not touched: that costs no memory.
    buffer = DictRolloutBuffer(n_steps, space, spaces.Discrete(2), device="cpu", n_envs=n_rows)
    return sum(array.nbytes for array in buffer.observations.values())


def rollout_memory(model: Any, observation_bytes: int) -> dict[str, Any]:
    """Compare a rollout's observations with those of ``DictRolloutBuffer``.

    :param model: gives steps, rows and observation space
    :param observation_bytes: of its own buffer
    :return: plain data
    """
    found: dict[str, Any] = {"observation_bytes": observation_bytes}
    for name, float32 in (("float32", True), ("installed", False)):
        theirs = dict_buffer_bytes(
            model.observation_space, model.n_steps, model.env.num_envs, float32
        )
        ratio = theirs / observation_bytes
        found[f"dict_rollout_buffer_{name}"] = {
            "bytes": theirs,
            "ratio": ratio,
            "target": MEMORY_TARGET,
            "met": ratio >= MEMORY_TARGET,
        }
    return found


def memory_cells(memory: Mapping[str, Any]) -> tuple[str, str, str]:
    """Write how many times as much ``DictRolloutBuffer`` takes, both ways, and the verdicts.

    :param memory: see :func:`rollout_memory`
    """
    rivals = [memory[f"dict_rollout_buffer_{name}"] for name in ("float32", "installed")]
    verdicts = ["met" if one["met"] else "MISSED" for one in rivals]
    first, second = (f"{one['ratio']:.1f} times" for one in rivals)
    return first, second, f">= {rivals[0]['target']:g} {' / '.join(verdicts)}"


def available_memory() -> int | None:
    """Return the bytes that are free for more; None where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass  # not Linux
    names = getattr(os, "sysconf_names", {})
    if "SC_PHYS_PAGES" not in names:
        return None
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
