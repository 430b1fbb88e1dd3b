"""Everything that the future of a training run depends on, taken from a model and put back.

A snapshot is taken between iterations, when the last update is done and the next rollout has not
begun: the rollout buffer is empty then. Training that goes on from it ends in the same weights,
optimizer, logs and environments as training that was never stopped.
"""

from __future__ import annotations

import copy
import random
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.common.checkpoint import Checkpoint, CheckpointError
from sb3_roles.common.checkpoint_fit import (
    check_like,
    check_weights,
    fitting,
    parameter_of,
    parameters_of,
)
from sb3_roles.common.env_state import env_state, laid_out_like, set_env_state
from sb3_roles.common.team_wrapper import find_team_env

_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_current_progress_remaining")


def _begin_anew(model: OnPolicyAlgorithm, env: VecEnv) -> None:
    """Start new episodes, of streams that are a function of the run's seed and of where it is.

    With the seed alone, a resumed run would play the first episodes of the run again. What the
    wrappers, an LSTM and the callbacks knew of the episodes that were cut off does not hold.
    """
    if model.seed is not None:
        env_steps = model.num_timesteps // find_team_env(env).n_agents
        words = np.random.SeedSequence([model.seed, env_steps]).generate_state(1)
        env.seed(int(words[0]))
    model._last_obs = env.reset()  # type: ignore[assignment]
    model._last_episode_starts = np.ones(env.num_envs, np.bool_)


# Random numbers


def rng_state() -> dict[str, Any]:
    """Return the global generators of torch, numpy and python."""
    name, keys, position, has_gauss, gauss = np.random.get_state()  # noqa: NPY002
    version, internal, gauss_next = random.getstate()
    cuda = th.cuda.get_rng_state_all() if th.cuda.is_available() else []
    return {
        "torch": th.get_rng_state().numpy(),
        "cuda": [one.numpy() for one in cuda],
        "numpy": [str(name), keys, int(position), int(has_gauss), float(gauss)],
        "python": [version, np.array(internal, np.uint64), gauss_next],
    }


def set_rng_state(state: Mapping[str, Any]) -> None:
    """Set the global generators of torch, numpy and python."""
    th.set_rng_state(th.from_numpy(np.array(state["torch"])))
    if state["cuda"] and th.cuda.device_count() == len(state["cuda"]):
        th.cuda.set_rng_state_all([th.from_numpy(np.array(one)) for one in state["cuda"]])
    name, keys, position, has_gauss, gauss = state["numpy"]
    np.random.set_state((name, keys, position, has_gauss, gauss))  # noqa: NPY002
    version, internal, gauss_next = state["python"]
    random.setstate((version, tuple(int(word) for word in internal), gauss_next))


@contextmanager
def kept_rng() -> Iterator[None]:
    """Put the global generators back at the end, for what draws from them on its own behalf."""
    state = rng_state()
    try:
        yield
    finally:
        set_rng_state(state)


# The model


def _optimizer_tensors(model: OnPolicyAlgorithm) -> dict[str, th.Tensor]:
    return {
        f"{index}.{name}": th.as_tensor(value)
        for index, entries in model.policy.optimizer.state_dict()["state"].items()
        for name, value in entries.items()
    }


def capture(model: OnPolicyAlgorithm, stateful: Sequence[Any] = ()) -> dict[str, Any]:
    """Take a snapshot between two iterations: copies, which do not change as training goes on.

    :param model: the algorithm, with its environment
    :param stateful: callbacks and writers with ``get_state()``
    :return: ``policy``, ``optimizer`` and ``state`` of ``write_checkpoint``
    """
    assert model.env is not None
    logger = model.logger
    last_obs: Any = model._last_obs
    lstm = getattr(model, "_last_lstm_states", None)
    values = {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in logger.name_to_value.items()
        if isinstance(value, (bool, int, float, str, np.generic))
    }
    state = {
        "counters": {name: getattr(model, name) for name in _COUNTERS},
        "elapsed_ns": time.time_ns() - model.start_time,
        "kl_coefs": list(getattr(model, "kl_coefs", [])),
        "optimizer_rates": [group["lr"] for group in model.policy.optimizer.param_groups],
        "env": env_state(model.env),
        "last_obs": dict(last_obs) if isinstance(last_obs, dict) else {"": last_obs},
        "last_episode_starts": np.asarray(model._last_episode_starts),
        "lstm": None if lstm is None else [[t.cpu().numpy() for t in pair] for pair in lstm],
        "ep_info": list(model.ep_info_buffer or ()),
        "ep_success": list(model.ep_success_buffer or ()),
        "logger": {
            "values": values,
            "counts": {key: logger.name_to_count[key] for key in values},
            "excluded": {key: logger.name_to_excluded.get(key, ()) for key in values},
        },
        "stateful": [[type(one).__name__, one.get_state()] for one in stateful],
        "rng": rng_state(),
    }
    return {
        "policy": _copied(model.policy.state_dict()),
        "optimizer": _copied(_optimizer_tensors(model)),
        "state": copy.deepcopy(state),
    }


def _copied(tensors: Mapping[str, th.Tensor]) -> dict[str, th.Tensor]:
    return {name: tensor.detach().clone() for name, tensor in tensors.items()}


def load_weights(model: OnPolicyAlgorithm, checkpoint: Checkpoint) -> None:
    """Put weights and buffers into a policy that was built from the configuration.

    :param model: the algorithm
    :param checkpoint: read from a file
    :raises CheckpointError: if a name, shape or dtype is another one; nothing is changed then
    """
    check_weights(checkpoint.policy, model.policy.state_dict())
    model.policy.load_state_dict(checkpoint.policy)


def _load_optimizer(model: OnPolicyAlgorithm, checkpoint: Checkpoint) -> None:
    optimizer = model.policy.optimizer
    parameters = parameters_of(model)
    entries: dict[int, dict[str, th.Tensor]] = {}
    for key, tensor in checkpoint.optimizer.items():
        index, _, name = key.partition(".")
        parameter = parameter_of(key, parameters)
        if tensor.ndim == 0:
            entries.setdefault(int(index), {})[name] = tensor
            continue
        check_like(f"optimizer's {key}", tensor, parameter)
        # Laid out like the parameter, as the optimizer itself would: fused kernels rely on it.
        like = th.empty_like(parameter, requires_grad=False)
        entries.setdefault(int(index), {})[name] = like.copy_(tensor)
    optimizer.load_state_dict({**optimizer.state_dict(), "state": entries})


def restore(model: OnPolicyAlgorithm, checkpoint: Checkpoint) -> None:
    """Put a snapshot back, except for generators and callbacks.

    :param model: built from the same configuration, its ``_setup_learn`` done: the environment is
        reset and the logger exists
    :param checkpoint: read from a file
    :raises CheckpointError: if it does not fit
    """
    assert model.env is not None
    state = checkpoint.state
    with fitting():
        load_weights(model, checkpoint)
        _load_optimizer(model, checkpoint)
        for group, rate in zip(
            model.policy.optimizer.param_groups, state["optimizer_rates"], strict=True
        ):
            group["lr"] = rate
        for name in _COUNTERS:
            value = state["counters"][name]
            if type(value) not in (int, float) or not 0 <= value < 2**53:
                raise CheckpointError(f"damaged checkpoint: {name} is {str(value)[:40]}")
            setattr(model, name, value)
        model.start_time = time.time_ns() - int(state["elapsed_ns"])
        if state["kl_coefs"]:
            model.kl_coefs = [float(one) for one in state["kl_coefs"]]  # type: ignore[attr-defined]
        if state["env"]["teams"] is None:
            _begin_anew(model, model.env)
        else:
            set_env_state(model.env, state["env"])
            _set_observations(model, state)
            if state["lstm"] is not None:
                _set_lstm(model, state["lstm"])
        window = model._stats_window_size
        model.ep_info_buffer = deque(state["ep_info"], maxlen=window)
        model.ep_success_buffer = deque(state["ep_success"], maxlen=window)
        logger = state["logger"]
        for key, value in logger["values"].items():
            model.logger.name_to_value[key] = value
            model.logger.name_to_count[key] = logger["counts"][key]
            model.logger.name_to_excluded[key] = tuple(logger["excluded"][key])


def _set_observations(model: OnPolicyAlgorithm, state: Mapping[str, Any]) -> None:
    fresh: Any = model._last_obs
    is_dict = isinstance(fresh, dict)
    templates = fresh if is_dict else {"": fresh}
    saved = state["last_obs"]
    if set(saved) != set(templates):
        raise CheckpointError("the last observation has other keys than the environment's")
    restored = {}
    for key, template in templates.items():
        if saved[key].shape != template.shape or saved[key].dtype != template.dtype:
            raise CheckpointError(f"the last observation {key!r} has another shape or dtype")
        restored[key] = laid_out_like(template, saved[key])
    model._last_obs = restored if is_dict else restored[""]
    model._last_episode_starts = np.array(state["last_episode_starts"])


def _set_lstm(model: Any, saved: Sequence[Sequence[np.ndarray]]) -> None:
    fresh = model._last_lstm_states
    pairs = []
    for pair, old in zip(saved, fresh, strict=True):
        tensors = [th.from_numpy(np.array(one)).to(model.device) for one in pair]
        for given, wanted in zip(tensors, old, strict=True):
            check_like("LSTM states", given, wanted)
        pairs.append(tuple(tensors))
    model._last_lstm_states = type(fresh)(*pairs)


def restore_stateful(stateful: Sequence[Any], checkpoint: Checkpoint) -> None:
    """Put the state of callbacks and writers back.

    :param stateful: as given to :func:`capture`, in that order
    :param checkpoint: read from a file
    :raises CheckpointError: if these are others
    """
    names = [type(one).__name__ for one in stateful]
    with fitting():
        saved = checkpoint.state["stateful"]
        if [name for name, _ in saved] != names:
            had = str([name for name, _ in saved])[:200]
            raise CheckpointError(f"the run had the callbacks {had}, now {names}")
        for one, (_, state) in zip(stateful, saved, strict=True):
            one.set_state(state)
