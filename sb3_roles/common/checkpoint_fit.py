"""Whether a checkpoint fits the configuration of a run."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_roles.common.checkpoint import CheckpointError
from sb3_roles.common.checkpoint_reading import Outline
from sb3_roles.common.env_failures import EnvironmentFailed
from sb3_roles.common.names import one_line

# Arrays that a state may have beside those whose size goes with the observations, and how many
# times these: maps, generators, what wrappers and recurrent policies remember.
_ARRAYS_ANYWAY, _OBSERVATIONS = 64 << 20, 64
_MOST_OF_A_PARAMETER = 8


@contextmanager
def fitting() -> Iterator[None]:
    """Turn all ways of a checkpoint not to fit into one line.

    :raises CheckpointError: if what is done inside fails
    """
    try:
        yield
    except (CheckpointError, EnvironmentFailed):
        raise
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError) as error:
        message = f"the checkpoint does not fit the configuration: {one_line(error)}"
        raise CheckpointError(message) from error


def check_weights(
    given: Mapping[str, th.Tensor],
    own: Mapping[str, th.Tensor],
    what: str = "weights",
    owner: str = "configuration",
) -> None:
    """Refuse weights that are not those of a policy, by name, shape and dtype.

    :param given: of a file
    :param own: of the policy
    :param what: what the message calls the former
    :param owner: what they should fit
    :raises CheckpointError: if a name, shape or dtype is another one
    """
    odd = sorted(set(own) ^ set(given))
    if odd:
        raise CheckpointError(f"the {what} do not fit the {owner}: {odd[0]} is in one only")
    for name, tensor in own.items():
        check_like(f"{what} {name}", given[name], tensor, owner)


def check_like(
    what: str, given: th.Tensor, wanted: th.Tensor, owner: str = "configuration"
) -> None:
    """Refuse a tensor of another shape or dtype.

    :param what: what the message calls it
    :param given: of a file; may be without memory
    :param wanted: of the model
    :param owner: what it should fit
    :raises CheckpointError: if it is another
    """
    if given.shape != wanted.shape or given.dtype != wanted.dtype:
        raise CheckpointError(
            f"the {what} do not fit the {owner}: {given.dtype} {tuple(given.shape)}, "
            f"expected {wanted.dtype} {tuple(wanted.shape)}"
        )


def check_outline(model: OnPolicyAlgorithm, outline: Outline) -> None:
    """Refuse a checkpoint that can not be the model's, before it takes memory.

    :param model: the algorithm, with its environment
    :param outline: what a file declares
    :raises CheckpointError: if weights or optimizer are of another shape, or the arrays of the
        state are larger than any that belong to so many robots
    """
    check_weights(outline.policy, model.policy.state_dict())
    parameters = parameters_of(model)
    for key, tensor in outline.optimizer.items():
        parameter = parameter_of(key, parameters)
        if tensor.ndim:
            check_like(f"optimizer's {key}", tensor, parameter)
    if len(outline.optimizer) > _MOST_OF_A_PARAMETER * len(parameters):
        raise CheckpointError("the optimizer does not fit the configuration: too many tensors")
    size = sum(space.dtype.itemsize * math.prod(space.shape) for space in _spaces(model))
    most = _ARRAYS_ANYWAY + _OBSERVATIONS * size * model.n_envs
    if outline.array_bytes > most:
        raise CheckpointError(
            f"the state does not fit the configuration: {outline.array_bytes} bytes of arrays, "
            f"expected at most {most}"
        )


def _spaces(model: OnPolicyAlgorithm) -> list[Any]:
    space: Any = model.observation_space
    return list(space.values()) if isinstance(space, spaces.Dict) else [space]


def parameters_of(model: OnPolicyAlgorithm) -> list[th.Tensor]:
    """Return what the optimizer updates, in its order.

    :param model: the algorithm
    """
    return [one for group in model.policy.optimizer.param_groups for one in group["params"]]


def parameter_of(key: str, parameters: Sequence[th.Tensor]) -> th.Tensor:
    """Return the parameter that a tensor of the optimizer belongs to.

    :param key: ``<parameter's index>.<name>``
    :param parameters: of :func:`parameters_of`
    :raises CheckpointError: if there is none
    """
    index = key.partition(".")[0]
    if not (index.isdecimal() and len(index) < 10 and int(index) < len(parameters)):
        raise CheckpointError(f"the optimizer does not fit the configuration: {key[:80]!r}")
    return parameters[int(index)]
