"""Stock PPO of Stable-Baselines3 as a rival in speed: its own buffer, update and policy class.

Its networks read the same observations, map by map and robot by robot, through encoders and heads
of the sizes of the tuned default's. There is no graph, because a stock buffer mixes the rows of
teams, and nothing is conditioned on the role: it computes somewhat less per sample.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from sb3_roles.zoo.models import complete, step_on_threads


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
    """Hidden layers, one column of them for each head of the tuned default.

    :param extractor: what they read; actors do not read the state
    :param actors: widths of each column
    :param critics: the same
    """

    def __init__(
        self,
        extractor: ViewAndState,
        actors: Sequence[Sequence[int]],
        critics: Sequence[Sequence[int]],
    ) -> None:
        super().__init__()
        self._seen = extractor.view.features_dim
        self.actors = nn.ModuleList(mlp(self._seen, widths) for widths in actors)
        self.critics = nn.ModuleList(mlp(extractor.features_dim, widths) for widths in critics)
        self.latent_dim_pi = sum(widths[-1] for widths in actors)
        self.latent_dim_vf = sum(widths[-1] for widths in critics)

    def forward(self, features: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        return self.forward_actor(features), self.forward_critic(features)

    def forward_actor(self, features: th.Tensor) -> th.Tensor:
        seen = features[:, : self._seen]
        return th.cat([actor(seen) for actor in self.actors], dim=1)

    def forward_critic(self, features: th.Tensor) -> th.Tensor:
        return th.cat([critic(features) for critic in self.critics], dim=1)


class StockPolicy(MultiInputActorCriticPolicy):
    """SB3's policy for Dict observations; ``net_arch`` has lists of columns, ``pi`` and ``vf``."""

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.features_extractor, ViewAndState)
        columns: Any = self.net_arch
        self.mlp_extractor = _ActorAndCritic(  # type: ignore[assignment]
            self.features_extractor, columns["pi"], columns["vf"]
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
    step_on_threads(venv, th.get_num_threads())
    env = RoleWrapper(venv, **config["wrapper_kwargs"])
    own = complete(config)["policy_kwargs"]
    arguments = ALGORITHMS["ppo"].arguments(config, env.n_agents)
    del arguments["rollout_buffer_class"]
    arguments["policy_kwargs"] = {
        "features_extractor_class": ViewAndState,
        "features_extractor_kwargs": {"encoder": own["encoder"]},
        "net_arch": {
            "pi": [[*own["role_arch"], *own["role_head_arch"]], own["primitive_arch"]],
            "vf": [own["value_arch"], own["value_arch"]],
        },
        "activation_fn": nn.ReLU,
        "optimizer_kwargs": own.get("optimizer_kwargs"),
    }
    model = PPO(StockPolicy, env, seed=config["seed"], device="cpu", **arguments)
    return TrainingCase(name, env, model)
