"""Observations that are no maps, as vectors: one place for every policy."""

from __future__ import annotations

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim, preprocess_obs

from sb3_roles.common.torch_layers import symlog


def vector_size(space: spaces.Space) -> int:
    """Return the size of :func:`as_vectors`: one entry per choice of discrete spaces.

    :param space: Box, Discrete, MultiDiscrete or MultiBinary
    """
    # SB3 gives a numpy integer for MultiDiscrete, which PyTorch's layers refuse.
    return int(get_flattened_obs_dim(space))


def compressed(space: spaces.Space, vectors: th.Tensor) -> th.Tensor:
    """Bring quantities without an upper bound to a size that networks can read.

    :param space: of the observation
    :param vectors: float (n, size)
    :return: the same, or its symlog
    """
    unbounded = isinstance(space, spaces.Box) and not np.isfinite(space.high).all()
    return symlog(vectors) if unbounded else vectors


def as_vectors(space: spaces.Space, values: th.Tensor) -> th.Tensor:
    """Turn observations into vectors; choices of discrete spaces become one-hots.

    :param space: Box, Discrete, MultiDiscrete or MultiBinary
    :param values: any dtype (n, ...), as the environment or a buffer gives them
    :return: float (n, size)
    """
    encoded = preprocess_obs(values, space, normalize_images=False)
    assert isinstance(encoded, th.Tensor)
    return compressed(space, encoded.reshape(len(values), -1))
