"""``TeamPolicy``: what the policies of all team algorithms have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.type_aliases import Schedule
from torch import nn

from sb3_roles.common.checks import check_trusted
from sb3_roles.common.names import closest
from sb3_roles.common.role_wrapper import ROLE_DUE_KEY, ROLE_KEY
from sb3_roles.common.team_wrapper import AGENT_KEY
from sb3_roles.common.torch_layers import (
    NORM_LAYERS,
    Head,
    MapEncoder,
    PatchEncoder,
    communication_graph,
    make_map_encoder,
    map_style,
    resolve_precision,
)
from sb3_roles.common.vectors import as_vectors, vector_size

STATE_KEY = "state"
POSITION_KEY = "position"
# Read by the policy itself, never by its networks.
_STRUCTURE_KEYS = (AGENT_KEY, ROLE_KEY, ROLE_DUE_KEY, POSITION_KEY)

Observation = Mapping[str, th.Tensor]
SelfTeamPolicy = TypeVar("SelfTeamPolicy", bound="TeamPolicy")


class Streams(NamedTuple):
    """What a policy says of the rows of some teams, one entry or column per stream.

    A stream is one level of decision with its own reward and value: the move for MAPPO; the role
    and the move for HMAPPO. n is the number of rows, S of streams, K_s of choices in a stream.
    """

    actions: th.Tensor
    """int64 (n, S)"""
    log_probs: tuple[th.Tensor, ...]
    """per stream float32 (n, K_s), normalized"""
    values: th.Tensor
    """float32 (n, S), the values that the advantages are measured against"""
    expected_values: th.Tensor
    """float32 (n, S), the values to bootstrap with, before any choice is made"""
    active: th.Tensor
    """bool (n, S), whether the stream decides in this row"""


class TeamPolicy(ActorCriticPolicy):
    """Actors that see what a robot sees, critics that may see the state, encoders for both.

    Observations are a Dict with the key ``agent`` of :class:`~sb3_roles.common.team_wrapper.
    TeamWrapper`, rows contiguous by team. Keys that are shared by a team may be given once per team
    (leading dimension n_teams): they are encoded once and expanded. No parameter and no saved space
    depends on the number of robots, and maps of any size can be encoded.

    :param observation_space: flat Dict
    :param action_space: as the subclass says
    :param lr_schedule: learning rate
    :param actor_keys: what the actors read; by default all but the state
    :param critic_keys: what the critics read (``"state"`` makes them central); by default all
    :param share_encoders: one encoder per key for all networks instead of one for each of them
    :param norm_layer: behind the joint encoder's convolutions: ``"none"``, ``"frozen_batch"``, or
        ``"group"``
    :param graph: let robots exchange features before they decide
    :param graph_width: size of a robot's features behind the graph layer
    :param communication_radius: robots strictly nearer than this, by the key ``position``, are
        linked; None links whole teams
    :param encoder: how maps are read: ``"convolutions"`` (the released code's) or ``"patches"``
        (several times faster on a CPU)
    :param local_channels: sizes of the layers of the encoder for small maps
    :param joint_channels: the same for large maps
    :param state_channels: the same for the key ``state``
    :param precision: of the products in the map encoders: ``"fp32"``, ``"bf16"`` (their weights and
        everything else stay float32), or ``"auto"``: bf16 where the hardware multiplies it
    :param optimizer_kwargs: further arguments of Adam
    :raises ValueError: if a key or an option is unknown
    """

    stream_names: ClassVar[tuple[str, ...]]
    observation_space: spaces.Dict

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *,
        actor_keys: Sequence[str] | None = None,
        critic_keys: Sequence[str] | None = None,
        share_encoders: bool = False,
        norm_layer: str = "none",
        graph: bool = True,
        graph_width: int = 128,
        communication_radius: float | None = None,
        encoder: str = "convolutions",
        local_channels: Sequence[int] | None = None,
        joint_channels: Sequence[int] | None = None,
        state_channels: Sequence[int] | None = None,
        precision: str = "fp32",
        use_sde: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        if use_sde:
            raise ValueError("use_sde is for continuous actions; teams act with discrete ones")
        if not isinstance(observation_space, spaces.Dict) or (
            AGENT_KEY not in observation_space.spaces
        ):
            raise ValueError(
                f"the observation space has no key {AGENT_KEY!r}: wrap the environment in "
                "TeamWrapper or RoleWrapper"
            )
        self._options: dict[str, Any] = {
            "actor_keys": actor_keys,
            "critic_keys": critic_keys,
            "share_encoders": share_encoders,
            "norm_layer": norm_layer,
            "graph": graph,
            "graph_width": graph_width,
            "communication_radius": communication_radius,
            "encoder": encoder,
            "local_channels": local_channels,
            "joint_channels": joint_channels,
            "state_channels": state_channels,
            "precision": precision,
        }
        readable = [key for key in observation_space.spaces if key not in _STRUCTURE_KEYS]
        own = [key for key in readable if key != STATE_KEY]
        for keys in (actor_keys, critic_keys):
            for key in keys or ():
                if key not in readable:
                    raise ValueError(closest("observation key", key, readable))
        if STATE_KEY in (actor_keys or ()):
            raise ValueError("actors never read 'state': they must act without it (CTDE)")
        self.actor_keys = tuple(own if actor_keys is None else actor_keys)
        self.critic_keys = tuple(readable if critic_keys is None else critic_keys)
        if not self.actor_keys or not self.critic_keys:
            raise ValueError(
                f"actors and critics must read at least one key each, of {readable}; 'state' is "
                "for critics only"
            )
        if norm_layer not in NORM_LAYERS:
            raise ValueError(closest("norm_layer", norm_layer, NORM_LAYERS))
        if communication_radius is not None and not communication_radius >= 0:
            raise ValueError(
                f"communication_radius must be at least 0 or None, got {communication_radius!r}"
            )
        self.share_encoders = share_encoders
        self.norm_layer = norm_layer
        self.graph = graph
        self.graph_width = graph_width
        self.communication_radius = communication_radius
        self.encoder = encoder
        self.channels = {
            "local": local_channels,
            "joint": joint_channels,
            "state": state_channels,
        }
        self.precision = precision
        resolve_precision(precision, "cpu")
        # Evaluation may switch messages off without touching the weights.
        self.communicate = True
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            net_arch=[],
            optimizer_class=optimizer_class,
            optimizer_kwargs=optimizer_kwargs,
        )

    @classmethod
    def load(
        cls: type[SelfTeamPolicy],
        path: str,
        device: th.device | str = "auto",
        trust: bool = False,
    ) -> SelfTeamPolicy:
        """Load what SB3's ``save`` of a policy wrote.

        :param path: the file
        :param device: where the policy shall be
        :param trust: must be true: the file is a pickle, which runs whatever code it names
        :raises ValueError: if ``trust`` is not given
        """
        check_trusted(f"{cls.__name__}.load", path, trust)
        return super().load(path, device)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "lr_schedule": self._dummy_schedule,
            "optimizer_class": self.optimizer_class,
            "optimizer_kwargs": self.optimizer_kwargs,
            **self._options,
        }

    def _build(self, lr_schedule: Schedule) -> None:
        self.encoders = nn.ModuleDict()
        # Of the encoders of a key, which all cut maps alike, the first one.
        self._map_readers: dict[str, str] = {}
        self._build_networks()
        for module in self.modules():
            if isinstance(module, (nn.Linear, nn.Conv2d)):
                self.init_weights(module, gain=float(np.sqrt(2.0)))
        # Small outputs at first: nearly uniform choices, values near 0.
        for module in self.modules():
            if isinstance(module, Head):
                nn.init.orthogonal_(module.out.weight, gain=module.gain)
        self.to(memory_format=th.channels_last)  # type: ignore[call-overload]
        self.optimizer = self.optimizer_class(
            self.parameters(),
            lr=lr_schedule(1),  # type: ignore[call-arg]
            **self.optimizer_kwargs,
        )

    @abstractmethod
    def _build_networks(self) -> None:
        """Create actors and critics; modules of critics have "value" in their name (for TRPO)."""

    @abstractmethod
    def streams(
        self,
        obs: Observation,
        actions: th.Tensor | None = None,
        deterministic: bool = False,
        generator: th.Generator | None = None,
    ) -> Streams:
        """Evaluate actors and critics on the rows of whole teams.

        :param obs: tensors by key
        :param actions: int64 (n, S), actions to evaluate; None to choose
        :param deterministic: choose the most probable ones
        :param generator: to choose with, of the policy's device; None for torch's own
        :return: see :class:`Streams`; with ``actions``, ``expected_values`` is not computed and
            equals ``values``
        """

    # Encoders

    def _encoder_name(self, owner: str, key: str) -> str:
        if not self.share_encoders:
            return f"{owner}_{key}"
        return f"shared_{key}" if key in self.actor_keys else f"value_{key}"

    def _add_encoders(self, owner: str, keys: Sequence[str]) -> int:
        """Create what an owner needs to read some keys.

        :param owner: name of the network
        :param keys: observation keys
        :return: size of the concatenated features
        """
        size = 0
        for key in keys:
            shape = self.observation_space[key].shape or ()
            if not self._is_map(key):
                size += vector_size(self.observation_space[key])
                continue
            style = map_style(key, shape)
            name = self._encoder_name(owner, key)
            if name not in self.encoders:
                self.encoders[name] = make_map_encoder(
                    self.encoder, style, shape[0], self.channels[style], self.norm_layer
                )
            self._map_readers.setdefault(key, name)
            encoder = self.encoders[name]
            assert isinstance(encoder, (MapEncoder, PatchEncoder))
            size += encoder.out_features
        return size

    def prepare(self, obs: Observation) -> dict[str, th.Tensor]:
        """Bring observations to the form in which the encoders read them.

        It is done once for a rollout instead of once for each pass over it; :meth:`streams` takes
        observations in either form.

        :param obs: tensors by key
        :return: the same; maps that are read as patches are cut, (n, patches, size of a patch),
            unless they have another number of patches than the encoder's reference
        """
        prepared = dict(obs)
        for key, name in self._map_readers.items():
            encoder = self.encoders[name]
            if isinstance(encoder, PatchEncoder) and key in obs and encoder.fits(obs[key]):
                prepared[key] = encoder.cut(self._scaled(key, obs[key])).flatten(1, 2)
        return prepared

    def _encode(
        self, owner: str, keys: Sequence[str], obs: Observation, memo: dict[Any, th.Tensor]
    ) -> th.Tensor:
        """Read some keys.

        :param memo: what was read in this forward pass, so that shared encoders run once
        :return: float32 (n, size)
        """
        names = tuple(self._encoder_name(owner, key) if self._is_map(key) else key for key in keys)
        if names not in memo:
            rows = obs[AGENT_KEY].shape[0]
            parts = []
            for key, name in zip(keys, names, strict=True):
                if name not in memo:
                    memo[name] = self._read(key, name, obs[key])
                part = memo[name]
                if part.shape[0] != rows:
                    part = part.repeat_interleave(rows // part.shape[0], dim=0)
                parts.append(part)
            memo[names] = th.cat(parts, dim=1)
        return memo[names]

    def _read(self, key: str, name: str, value: th.Tensor) -> th.Tensor:
        """Read one key: a map by its encoder, in the policy's precision, anything else as it is."""
        if not self._is_map(key):
            return as_vectors(self.observation_space[key], value)
        # Only here: elsewhere matrices are so small that casting costs what bfloat16 gains.
        bf16 = resolve_precision(self.precision, value.device) == "bf16"
        with th.autocast(value.device.type, th.bfloat16, enabled=bf16):
            encoded: th.Tensor = self.encoders[name](self._scaled(key, value))
        return encoded.float()

    def _is_map(self, key: str) -> bool:
        return len(self.observation_space[key].shape or ()) == 3

    def _scaled(self, key: str, maps: th.Tensor) -> th.Tensor:
        """Bring images to [0, 1]; maps of 0 and 1 stay the bytes that they are."""
        space = self.observation_space[key]
        if not isinstance(space, spaces.Box):
            return maps
        high = float(space.high.max())
        scale = maps.dtype == th.uint8 and space.dtype == np.uint8 and high > 1.0
        return maps / high if scale else maps

    def _count_goals(self, goal_key: str | None, n_moves: int) -> int:
        """Check a key whose rows begin with flags of the moves towards sub-goals.

        :param goal_key: None for none
        :param n_moves: number of moves
        :return: number of rows
        :raises ValueError: if the actors do not read the key, or its shape does not fit
        """
        if goal_key is None:
            return 0
        if goal_key not in self.actor_keys:
            raise ValueError(closest("goal_key", goal_key, self.actor_keys))
        shape = self.observation_space[goal_key].shape or ()
        if len(shape) != 2 or shape[1] < n_moves:
            raise ValueError(
                f"goal_key {goal_key!r} must have rows that begin with a flag for each of the "
                f"{n_moves} moves, got shape {shape}"
            )
        return shape[0]

    # Teams

    @staticmethod
    def team_size(obs: Observation) -> int:
        """Read the number of robots of a team, and check that teams are whole.

        :param obs: tensors by key
        :return: n_agents
        :raises ValueError: if the rows are not those of whole teams, in order
        """
        agent = obs[AGENT_KEY]
        n_agents = int(agent[0, 1])
        expected = th.arange(n_agents, device=agent.device, dtype=agent.dtype)
        whole = agent.shape[0] % n_agents == 0
        if not whole or not bool((agent[:, 0].view(-1, n_agents) == expected).all()):
            raise ValueError(
                f"the rows are not whole teams of {n_agents} robots: use "
                "rollout_buffer_class=TeamRolloutBuffer (stock buffers mix the rows of teams), and "
                "predict for all robots of a team at once"
            )
        return n_agents

    def _graph(self, obs: Observation, features: th.Tensor, n_agents: int) -> th.Tensor:
        """Return S for rows of features, float (n_teams, n_agents, n_agents)."""
        like = features.view(-1, n_agents, features.shape[1])
        position = obs.get(POSITION_KEY)
        if position is not None:
            position = position.view(-1, n_agents, position.shape[-1]).float()
        graph = communication_graph(position, self.communication_radius, like)
        return graph if self.communicate else th.zeros_like(graph)

    # Stable-Baselines3's interface

    def obs_to_tensor(  # type: ignore[override]
        self, observation: Mapping[str, np.ndarray]
    ) -> tuple[dict[str, th.Tensor], bool]:
        """Convert the observations of whole teams, or of one row for the critics.

        :param observation: arrays by key, rows first; maps may have any size
        :return: tensors by key, and whether there was a rows' dimension
        :raises ValueError: if the observation is no dict of known keys
        """
        if not isinstance(observation, Mapping) or AGENT_KEY not in observation:
            raise ValueError(
                f"the observation must be a dict with the key {AGENT_KEY!r}, as TeamWrapper and "
                "RoleWrapper give it"
            )
        has_rows = np.ndim(observation[AGENT_KEY]) == 2
        tensors = {}
        for key, value in observation.items():
            if key not in self.observation_space.spaces:
                raise ValueError(closest("observation key", key, self.observation_space.spaces))
            array = np.asarray(value)
            tensor = th.as_tensor(array if has_rows else array[None])
            tensors[key] = tensor.to(self.device)
        return tensors, has_rows

    def forward(
        self, obs: th.Tensor | Observation, deterministic: bool = False
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Choose actions, for algorithms of one stream.

        :param obs: tensors by key
        :param deterministic: choose the most probable actions
        :return: actions (n, *action shape), values (n, 1), log-probabilities (n,)
        """
        chosen = self.streams(_as_dict(obs), deterministic=deterministic)
        log_prob = self._joint_log_prob(chosen)
        return self._to_space(chosen.actions), chosen.values[:, :1], log_prob

    @staticmethod
    def _joint_log_prob(chosen: Streams) -> th.Tensor:
        picked = [
            log_probs.gather(1, chosen.actions[:, s : s + 1])
            for s, log_probs in enumerate(chosen.log_probs)
        ]
        return th.cat(picked, dim=1).sum(1)

    def _to_space(self, actions: th.Tensor) -> th.Tensor:
        return actions.reshape(-1, *(self.action_space.shape or ()))

    def evaluate_actions(
        self, obs: th.Tensor | Observation, actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """Evaluate actions, for algorithms of one stream.

        :param obs: tensors by key
        :param actions: (n, *action shape)
        :return: values (n, 1), log-probabilities (n,), entropies (n,)
        """
        distribution = self.get_distribution(obs)
        values = self.predict_values(obs)
        entropy = distribution.entropy()
        assert entropy is not None  # both distributions have one in closed form
        return values, distribution.log_prob(actions), entropy

    @abstractmethod
    def get_distribution(self, obs: th.Tensor | Observation) -> Distribution:
        """Return the distribution over actions of whole teams."""

    @abstractmethod
    def predict_values(self, obs: th.Tensor | Observation) -> th.Tensor:
        """Return the first stream's values of any rows, float (n, 1)."""

    def _predict(
        self, observation: th.Tensor | Observation, deterministic: bool = False
    ) -> th.Tensor:
        distribution = self.get_distribution(observation)
        return self._to_space(distribution.get_actions(deterministic=deterministic))


def _as_dict(obs: th.Tensor | Observation) -> Observation:
    assert not isinstance(obs, th.Tensor), "team policies take Dict observations"
    return obs
