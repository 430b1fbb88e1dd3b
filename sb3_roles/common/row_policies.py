"""Policies of single robots for contrib's MaskablePPO and RecurrentPPO, and masks of blocked moves.

Contrib's buffers mix the rows of teams, so these policies have no graph; and they have one features
extractor for actor and critic, so that neither reads the state.
"""

from __future__ import annotations

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
from sb3_roles.common.torch_layers import CHANNELS, MapEncoder, map_style, symlog

_NOT_SEEN = (STATE_KEY, POSITION_KEY, AGENT_KEY, ROLE_DUE_KEY)


class OwnViewExtractor(BaseFeaturesExtractor):
    """What one robot sees: maps through the paper's encoders, all else as it is.

    :param observation_space: flat Dict
    """

    def __init__(self, observation_space: spaces.Dict) -> None:
        encoders: dict[str, nn.Module] = {}
        size = 0
        self._unbounded = set()
        for key, space in observation_space.spaces.items():
            shape = space.shape or ()
            if key in _NOT_SEEN:
                continue
            if len(shape) == 3:
                style = map_style(key, shape)
                encoder = MapEncoder(shape[0], style, CHANNELS[style])
                encoders[key] = encoder
                size += encoder.out_features
            else:
                encoders[key] = nn.Flatten()
                size += int(np.prod(shape))
                if not np.isfinite(space.high).all():  # type: ignore[attr-defined]
                    self._unbounded.add(key)
        super().__init__(observation_space, size)
        self.encoders = nn.ModuleDict(encoders)

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Encode rows.

        :param observations: float tensors by key, (n, ...)
        :return: float (n, features_dim)
        """
        parts = []
        for key, encoder in self.encoders.items():
            part = encoder(observations[key].float())
            parts.append(symlog(part) if key in self._unbounded else part)
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
        self._n_roles, self._n_moves = (int(n) for n in venv.action_space.nvec)
        self._blocked_moves = blocked_moves
        self.masks = np.ones((self.num_envs, self._n_roles + self._n_moves), bool)

    def _look(self, observations: Any) -> Any:
        held = observations[ROLE_DUE_KEY] < 0.5
        self.masks[:, : self._n_roles] = ~held | (observations[ROLE_KEY] > 0.5)
        if self._blocked_moves:
            self.masks[:, self._n_roles :] = open_moves(observations["local"])
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
