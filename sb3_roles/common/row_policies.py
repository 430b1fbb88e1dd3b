"""Policies of single robots for contrib's MaskablePPO and RecurrentPPO, and masks of blocked moves.

Contrib's buffers mix the rows of teams, so these policies have no graph; and they have one features
extractor for actor and critic, so that neither reads the state.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices, VecEnvStepReturn
from torch import nn

from sb3_roles.common.policies import POSITION_KEY, STATE_KEY
from sb3_roles.common.role_wrapper import ROLE_DUE_KEY, ROLE_KEY, RoleWrapper
from sb3_roles.common.team_wrapper import AGENT_KEY
from sb3_roles.common.torch_layers import make_map_encoder, map_style
from sb3_roles.common.vectors import compressed, vector_size

_NOT_SEEN = (STATE_KEY, POSITION_KEY, AGENT_KEY, ROLE_DUE_KEY)


class OwnViewExtractor(BaseFeaturesExtractor):
    """What one robot sees: maps through encoders, all else as it is.

    :param observation_space: flat Dict
    :param encoder: see :func:`~sb3_roles.common.torch_layers.make_map_encoder`; by default the
        paper's
    """

    def __init__(self, observation_space: spaces.Dict, encoder: str = "convolutions") -> None:
        encoders: dict[str, nn.Module] = {}
        size = 0
        for key, space in observation_space.spaces.items():
            shape = space.shape or ()
            if key in _NOT_SEEN:
                continue
            if len(shape) == 3:
                reader = make_map_encoder(encoder, map_style(key, shape), shape[0], None, "none")
                encoders[key] = reader
                size += reader.out_features
            else:
                encoders[key] = nn.Flatten()
                size += vector_size(space)
        super().__init__(observation_space, size)
        self.encoders = nn.ModuleDict(encoders)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Encode rows.

        :param observations: float tensors by key, (n, ...); SB3 has made one-hots of discrete ones
        :return: float (n, features_dim)
        """
        boxes = self._observation_space.spaces  # type: ignore[attr-defined]
        parts = []
        for key, encoder in self.encoders.items():
            part = encoder(observations[key].float())
            is_vector = isinstance(encoder, nn.Flatten)
            parts.append(compressed(boxes[key], part) if is_vector else part)
        return th.cat(parts, dim=1)


class MaskedRowPolicy(MaskableActorCriticPolicy):
    """One robot's role and move, independent of each other, with masks.

    :param arguments: see ``MaskableActorCriticPolicy``
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        options.setdefault("features_extractor_class", OwnViewExtractor)
        super().__init__(*arguments, **options)


class RecurrentRowPolicy(RecurrentActorCriticPolicy):
    """One robot's role and move, independent of each other, with memory.

    :param arguments: see ``RecurrentActorCriticPolicy``
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        options.setdefault("features_extractor_class", OwnViewExtractor)
        super().__init__(*arguments, **options)


def open_moves(local: np.ndarray) -> np.ndarray:
    """Return which moves of area search are not blocked, from what the robots see.

    :param local: (n, channels, side, side); the first channel is obstacles
    :return: bool (n, 5): stop, up, right, down, left
    """
    center = local.shape[2] // 2
    allowed = np.ones((len(local), 5), bool)
    for move, (dy, dx) in enumerate(((-1, 0), (0, 1), (1, 0), (0, -1)), start=1):
        allowed[:, move] = local[:, 0, center + dy, center + dx] == 0
    return allowed


def row_masks(
    observations: Mapping[str, np.ndarray], action_space: spaces.Space, blocked_moves: bool
) -> np.ndarray:
    """Return what rows may choose: a role that goes on is the only one, and moves that are open.

    :param observations: key -> (n, ...)
    :param action_space: ``MultiDiscrete`` of role and move, or ``Discrete`` moves
    :param blocked_moves: the environment is area search, whose blocked moves are known; others
        allow all moves
    :return: bool (n, n_roles + n_moves)
    """
    n = len(next(iter(observations.values())))
    parts = []
    if isinstance(action_space, spaces.MultiDiscrete):
        parts.append((observations[ROLE_DUE_KEY] > 0.5) | (observations[ROLE_KEY] > 0.5))
        n_moves = int(action_space.nvec[-1])
    else:
        assert isinstance(action_space, spaces.Discrete)
        n_moves = int(action_space.n)
    allowed = np.ones((n, n_moves), np.bool_)
    parts.append(open_moves(observations["local"]) if blocked_moves else allowed)
    return np.concatenate(parts, axis=1)


class OwnViewWrapper(VecEnvWrapper):
    """Takes the state out of the observations: these policies must act without it.

    :param venv: a ``RoleWrapper``
    """

    def __init__(self, venv: RoleWrapper) -> None:
        space = venv.observation_space
        assert isinstance(space, spaces.Dict)
        kept = {key: one for key, one in space.spaces.items() if key != STATE_KEY}
        super().__init__(venv, observation_space=spaces.Dict(kept))

    def reset(self) -> Any:
        """Start new episodes."""
        observations: Any = self.venv.reset()
        observations.pop(STATE_KEY, None)
        return observations

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step."""
        observations, rewards, dones, infos = self.venv.step_wait()
        assert isinstance(observations, dict)
        observations.pop(STATE_KEY, None)
        for info in infos:
            if "terminal_observation" in info:
                info["terminal_observation"].pop(STATE_KEY, None)
        return observations, rewards, dones, infos


class MaskWrapper(OwnViewWrapper):
    """Offers ``action_masks`` to MaskablePPO.

    A role that goes on is the only one allowed. Blocked moves are known for area search; other
    environments allow all moves.

    :param venv: a ``RoleWrapper``
    :param blocked_moves: the environment is area search
    """

    def __init__(self, venv: RoleWrapper, blocked_moves: bool) -> None:
        super().__init__(venv)
        assert isinstance(venv.action_space, spaces.MultiDiscrete)
        self._blocked_moves = blocked_moves
        self.masks = np.ones((self.num_envs, int(venv.action_space.nvec.sum())), np.bool_)

    def _look(self, observations: Any) -> Any:
        self.masks = row_masks(observations, self.action_space, self._blocked_moves)
        return observations

    def reset(self) -> Any:
        """Start new episodes."""
        return self._look(super().reset())

    def step_wait(self) -> VecEnvStepReturn:
        """Finish the step."""
        observations, rewards, dones, infos = super().step_wait()
        return self._look(observations), rewards, dones, infos

    def has_attr(self, attr_name: str) -> bool:
        """Whether there is an attribute; there is ``action_masks``."""
        return attr_name == "action_masks" or super().has_attr(attr_name)

    def env_method(
        self,
        method_name: str,
        *method_args: Any,
        indices: VecEnvIndices = None,
        **method_kwargs: Any,
    ) -> list[Any]:
        """Call a method of the environments; ``action_masks`` gives bool (n_roles + n_moves,)."""
        if method_name == "action_masks":
            return list(self.masks[list(self.unwrapped._get_indices(indices))])
        return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)

    def get_state(self) -> dict[str, Any]:
        """Return the masks of the coming step."""
        return {"masks": self.masks.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned."""
        self.masks[:] = state["masks"]
