"""What the tests of published weights share: runs of the paper's rows that were never trained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch as th

from sb3_roles.common.checkpoint import CheckpointFolder
from sb3_roles.evaluation.callback import save_policy
from sb3_roles.zoo.config import write_yaml
from sb3_roles.zoo.models import complete, make_env, make_model, small_config
from sb3_roles.zoo.plans import learned_rows, read_plan_file
from sb3_roles.zoo.row_configs import config_of_row

COMMIT = "0123456789abcdef0123456789abcdef01234567"
COMMAND = f"""train.py --algo hmappo -f /somewhere/else --num-threads 1
# sb3_roles 0.0.9, commit {COMMIT}
# python 3.11.7, torch 2.13.0+cpu, numpy unknown
# OMP_NUM_THREADS=1
"""
PROGRESS = """time/env_steps,time/agent_steps,time/time_elapsed,rollout/explo_paper,rollout/cover
3200,12800,3,,
6400,25600,7,0.7003733333333332,0.4683
9600,38400,61,0.7103733333333332,0.4783
"""
EVALUATIONS = """env_steps,agent_steps,explo_paper,explo_true,cover,n_episodes
5000,20000,0.95573,0.80944,0.69310000000000002,100.0
10000,40000,0.95733,0.80888,0.6912999999999999,100.0
"""


def make_run(
    folder: Path, row: str, seed: int, env_steps: int = 9600, **changes: Any
) -> dict[str, th.Tensor]:
    """Write a run folder as ``train`` leaves it, with weights that are drawn from a seed.

    :param folder: of the run
    :param row: of the paper's tables
    :param seed: of the training
    :param env_steps: joint steps of its weights
    :param changes: of the configuration
    :return: the weights of its policy
    """
    config = {**complete(config_of_row(learned_rows(read_plan_file())[row])), "seed": seed}
    config |= {"n_timesteps": 10_000, **changes}
    small = small_config(config, 1)
    model = make_model(small, make_env(small), "cpu")
    generator = th.Generator().manual_seed(env_steps + 1000 * seed)
    for parameter in model.policy.parameters():
        noise = th.randn(parameter.shape, generator=generator)
        parameter.data += 0.02 * noise
    folder.mkdir(parents=True)
    write_yaml(folder / "config.yml", config)
    write_yaml(folder / "args.yml", {"num_threads": 1, "eval_freq": 5000, "log_folder": "/else"})
    for name, text in (
        ("command.txt", COMMAND),
        ("progress.csv", PROGRESS),
        ("evaluations.csv", EVALUATIONS),
    ):
        (folder / name).write_text(text)
    weights = model.policy.state_dict()
    checkpoints = CheckpointFolder(folder / "checkpoints")
    checkpoints.prepare()
    steps = {"env_steps": env_steps, "agent_steps": 4 * env_steps}
    checkpoints.save(env_steps, manifest=steps, policy=weights)
    model.num_timesteps = 4 * 5000
    save_policy(model, folder / "best", {"env_steps": 5000})
    return {name: tensor.clone() for name, tensor in weights.items()}
