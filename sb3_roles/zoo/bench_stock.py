"""Stock PPO of Stable-Baselines3 as a rival in speed: its own buffer, update and policy class.

Its networks are as large as those of the tuned default and read the same observations, map by map
and robot by robot. It has one actor for role and move, and one critic: fewer heads, and no graph,
because a stock buffer mixes the rows of teams. So it computes somewhat less per sample.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_roles.common.policies import STATE_KEY
from sb3_roles.common.role_wrapper import RoleWrapper
from sb3_roles.common.row_policies import OwnViewExtractor
from sb3_roles.common.team_vec_env import make_team_vec_env
from sb3_roles.common.torch_layers import make_map_encoder, mlp
from sb3_roles.zoo.algorithms import ALGORITHMS
from sb3_roles.zoo.bench_case import TrainingCase
from sb3_roles.zoo.environments import env_factory
from sb3_roles.zoo.models import complete


class ViewAndState(BaseFeaturesExtractor):
    """What a robot sees, and behind it the state, for the critic only.

    :param observation_space: flat Dict with the key ``state``
    :param encoder: see ``make_map_encoder``
    """

    def __init__(self, observation_space: spaces.Dict, encoder: str) -> None:
        seen = {key: one for key, one in observation_space.spaces.items() if key != STATE_KEY}
        view = OwnViewExtractor(spaces.Dict(seen), encoder)
        channels = observation_space[STATE_KEY].shape[0]  # type: ignore[index]
        state = make_map_encoder(encoder, "state", channels, None, "none")
        super().__init__(observation_space, view.features_dim + state.out_features)
        self.view, self.state = view, state

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Encode rows.

        :param observations: float tensors by key, (n, ...)
        :return: float (n, features_dim)
        """
        state = self.state(observations[STATE_KEY])
        return th.cat([self.view(observations), state], dim=1)


class _ActorAndCritic(nn.Module):
    """The hidden layers of both; the actor does not read the state."""

    def __init__(self, extractor: ViewAndState, actor: list[int], critic: list[int]) -> None:
        super().__init__()
        self._seen = extractor.view.features_dim
        self.actor = mlp(self._seen, actor)
        self.critic = mlp(extractor.features_dim, critic)
        self.latent_dim_pi, self.latent_dim_vf = actor[-1], critic[-1]

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        return self.actor(features[:, : self._seen])

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return self.critic(features)


class StockPolicy(MultiInputActorCriticPolicy):
    """SB3's policy for Dict observations; ``net_arch`` has the lists ``pi`` and ``vf``."""

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.features_extractor, ViewAndState)
        assert isinstance(self.net_arch, dict)
        self.mlp_extractor = _ActorAndCritic(  # type: ignore[assignment]
            self.features_extractor, self.net_arch["pi"], self.net_arch["vf"]
        )


def stock_case(name: str, config: Mapping[str, Any], backend: str) -> TrainingCase:
    """Make stock PPO for the task of a configuration of HMAPPO.

    It takes from it all that PPO knows: rollouts, minibatches, epochs, learning rate, coefficients.

    :param name: what reports call it
    :param config: checked, of ``hmappo``
    :param backend: ``"native"`` or ``"supersuit"``
    """
    factory = env_factory(config["env"], config["env_kwargs"])
    # As SB3 takes it: what a team shares is repeated for each robot.
    venv = make_team_vec_env(factory, config["n_envs"], backend=backend)
    env = RoleWrapper(venv, **config["wrapper_kwargs"])
    own = complete(config)["policy_kwargs"]
    arguments = ALGORITHMS["ppo"].arguments(config, env.n_agents)
    del arguments["rollout_buffer_class"]
    arguments["policy_kwargs"] = {
        "features_extractor_class": ViewAndState,
        "features_extractor_kwargs": {"encoder": own["encoder"]},
        "net_arch": {
            "pi": [*own["role_arch"], *own["role_head_arch"]],
            "vf": list(own["value_arch"]),
        },
        "activation_fn": nn.ReLU,
        "optimizer_kwargs": own.get("optimizer_kwargs"),
    }
    model = PPO(StockPolicy, env, seed=config["seed"], device="cpu", **arguments)
    return TrainingCase(name, env, model)
