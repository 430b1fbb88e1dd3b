"""R16: the memory of a long training does not grow."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback

from sb3_roles.prove.processes import environment
from sb3_roles.prove.promises import Outcome, Setting

ROBOT_STEPS = 5_000_000
LIMIT = 0.02
"""Growth after warm-up that is promised not to be exceeded."""
_WARM_UP, _WINDOW = 0.1, 0.05
_STATUS = Path("/proc/self/status")
# Many robots on a small map, and one pass over a rollout: robot steps are fast, and everything that
# a run of the defaults does is done. Counted in joint steps.
SCENE = {"height": 12, "width": 12, "n_targets": 20, "n_agents": 15, "horizon": 25}
CHANGES: dict[str, Any] = {
    "n_envs": 64,
    "n_steps": 25,
    "batch_size": 800,
    "n_epochs": 1,
    "env_kwargs": {**SCENE, "scene": "hard", "sub_goal": "nearest"},
}
_EVALUATION, _SAVES = {"eval_freq": 16_000, "eval_episodes": 16, "verbose": 0}, 8_000
_CODE = """
from sb3_roles.zoo.launcher import prepare_process

prepare_process()
import torch

torch.set_num_threads(1)
{before}
from sb3_roles.prove.memory import watch

watch({steps}, {folder!r}, {seed})
"""


class MemoryCallback(BaseCallback):
    """Notes the resident memory before each rollout, which is at the end of an iteration.

    :param path: a line of JSON each, robot steps so far and bytes
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path

    def _on_rollout_start(self) -> None:
        with open(self.path, "a", encoding="utf-8") as file:
            file.write(f"{json.dumps([self.num_timesteps, resident_bytes()])}\n")

    def _on_step(self) -> bool:
        return True


def resident_bytes() -> int:
    """Return the bytes of this process that are in memory; Linux counts them.

    :raises OSError: on another system
    """
    for line in _STATUS.read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) * 1024
    raise OSError(f"{_STATUS} has no VmRSS")


def watch(robot_steps: int, folder: str, seed: int) -> None:
    """Train in this process, and note its memory in ``memory.jsonl``.

    :param robot_steps: of the run
    :param folder: of the run
    :param seed: of the run
    """
    from sb3_roles.prove.training_runs import train_here
    from sb3_roles.zoo.config import load_settings, merge, resolve
    from sb3_roles.zoo.environments import AREA_SEARCH

    changes = {**CHANGES, "n_timesteps": robot_steps // int(SCENE["n_agents"])}
    settings = merge(load_settings("hmappo", AREA_SEARCH), changes)
    run = Path(folder)
    train_here(
        run,
        resolve("hmappo", AREA_SEARCH, settings, seed),
        save_freq=_SAVES,
        options=_EVALUATION,
        callbacks=[MemoryCallback(run / "memory.jsonl")],
    )


def samples(robot_steps: int, folder: Path, seed: int, before: str = "") -> list[list[int]]:
    """Train in a fresh process, and return robot steps and bytes at each end of an iteration.

    :param robot_steps: of the run
    :param folder: an empty folder of its own
    :param seed: of the run
    :param before: Python code that the process runs first
    :raises subprocess.CalledProcessError: if it fails
    """
    code = _CODE.format(before=before, steps=robot_steps, folder=str(folder), seed=seed)
    subprocess.run([sys.executable, "-c", code], env=environment(), check=True)
    return [json.loads(line) for line in (folder / "memory.jsonl").read_text().splitlines()]


def relative_growth(resident: list[int]) -> tuple[float, float]:
    """Return how much memory grew after warm-up, and what there was at its end.

    The medians of the first and of the last twentieth of the run are compared, after a first tenth
    that is left out.

    :param resident: bytes at the ends of the iterations, in their order
    :return: the share by which it grew, and bytes
    """
    window = max(1, round(_WINDOW * len(resident)))
    start = round(_WARM_UP * len(resident))
    first = float(np.median(resident[start : start + window]))
    return (float(np.median(resident[-window:])) - first) / first, first


def growth(setting: Setting, robot_steps: int = ROBOT_STEPS, before: str = "") -> Outcome:
    """Train for long, and compare the resident memory at the end with that after warm-up.

    :param setting: see :class:`Setting`
    :param robot_steps: of the run
    :param before: see :func:`samples`
    """
    if not _STATUS.exists():
        return Outcome(0, 0, "", skipped=f"{_STATUS} is not there, resident memory is not counted")
    found = samples(robot_steps, setting.folder, setting.seed, before)
    share, first = relative_growth([resident for _, resident in found])
    text = f"{100 * share:+.2f} % of {first / 2**20:.0f} MiB"
    said = (
        f"run of {robot_steps:,} robot steps of HMAPPO ({SCENE['n_agents']} robots, "
        f"{SCENE['height']} x {SCENE['width']} cells, sub-goals {CHANGES['env_kwargs']['sub_goal']}"
        f", {CHANGES['n_envs']} teams, 1 epoch, 1 thread, with evaluations, checkpoints and logs): "
        f"resident memory grew by {text}, over {len(found)} iterations"
    )
    kept = share < LIMIT
    failures = () if kept else (f"resident memory grew by {text}",)
    return Outcome(int(kept), 1, said, failures)
