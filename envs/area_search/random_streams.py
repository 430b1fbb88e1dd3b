"""Counter-based random numbers: one stream per (seed, episode), whatever plays it.

Draw ``i`` of a stream is a hash of (key, episode, i). No generator state has to be carried from one
episode to the next, so an episode is the same in any batch, on any worker, in any order.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31, _S11 = np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(11)


def seed_key(seed: int) -> np.ndarray:
    """Hash a seed of any size into the key of a stream.

    :param seed: a non-negative integer
    :return: uint64 array (2,)
    :raises ValueError: if the seed is not a non-negative integer
    """
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise ValueError(f"seed must be a whole number of at least 0, got {seed!r}")
    return np.random.SeedSequence(int(seed)).generate_state(2, np.uint64)


@njit(cache=True)
def mix(z: np.uint64) -> np.uint64:
    """Scramble 64 bits (the finalizer of SplitMix64)."""
    z = (z ^ (z >> _S30)) * _MIX_1
    z = (z ^ (z >> _S27)) * _MIX_2
    return z ^ (z >> _S31)


@njit(cache=True)
def episode_key(key: np.ndarray, episode: int) -> np.uint64:
    """Second word of an episode's key; the first is ``key[0]``."""
    return mix(key[1] ^ mix(np.uint64(episode) * _GAMMA + _GAMMA))


@njit(cache=True)
def draw(first: np.uint64, second: np.uint64, counter: np.uint64) -> np.uint64:
    """64 random bits: number ``counter`` of the stream with this 128-bit key."""
    return mix(mix(first + counter * _GAMMA) ^ second)


@njit(cache=True)
def to_unit(word: np.uint64) -> float:
    """Turn 64 random bits into a float in [0, 1)."""
    return np.float64(word >> _S11) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def normal_pair(
    first: np.uint64, second: np.uint64, counter: np.uint64
) -> tuple[float, float, np.uint64]:
    """Two independent standard normal numbers by the polar method.

    :return: the two numbers and the next unused counter
    """
    while True:
        u = 2.0 * to_unit(draw(first, second, counter)) - 1.0
        v = 2.0 * to_unit(draw(first, second, counter + np.uint64(1))) - 1.0
        counter += np.uint64(2)
        s = u * u + v * v
        if 0.0 < s < 1.0:
            scale = math.sqrt(-2.0 * math.log(s) / s)
            return u * scale, v * scale, counter
