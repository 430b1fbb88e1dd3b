"""Policies on the spatial graph: GNN (Tolstaya et al. 2021) and our reading of H2GNN."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, ClassVar

import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import CategoricalDistribution
from stable_baselines3.common.type_aliases import Schedule
from torch import nn
from torch.nn import functional as F

from area_search.cells import JOINT_CHANNELS, KNOWN_CHANNELS, N_ACTIONS
from sb3_roles.common.checks import check_positive
from sb3_roles.common.distributions import LOG_ZERO
from sb3_roles.common.policies import POSITION_KEY, Observation
from sb3_roles.common.torch_layers import Head, mlp
from sb3_roles.gnn.graphs import TeamGraphs, build_graphs
from sb3_roles.gnn.message_passing import MessagePassing
from sb3_roles.mappo.policies import TeamActorCriticPolicy

JOINT_KEY, KNOWN_KEY = "joint", "known"
_FRONTIER, _TARGET = JOINT_CHANNELS.index("frontier"), JOINT_CHANNELS.index("target")
_FREE = KNOWN_CHANNELS.index("free")


class GraphActorCriticPolicy(TeamActorCriticPolicy):
    """An actor on the team's graph, a central critic on maps.

    The actor reads the team's known map, frontier and targets and the positions of the robots:
    it knows what the team knows, and the graph takes the place of messages between robots. A move
    without an edge, into an obstacle or an unknown cell, has probability 0. Robots of a team may be
    numbered in any way, and weights fit teams and maps of any size. The critic is that of
    :class:`~sb3_roles.mappo.policies.TeamActorCriticPolicy`.

    :param n_hops: hops of message passing, 15 to 19 in the paper on GNN
    :param hop_width: size of a node's embedding
    :param head_arch: hidden layers between an action's features and its score
    :param value_arch: hidden layers of the critic
    :param critic_keys: what the critic reads; by default all keys
    :param norm_layer: as the following ones of the critic, see
        :class:`~sb3_roles.common.policies.TeamPolicy`
    :param encoder: how the critic reads maps
    :param local_channels: of its encoders
    :param joint_channels: the same
    :param state_channels: the same
    :param precision: of the critic; the graph is computed in float32
    :param optimizer_kwargs: further arguments of Adam
    :raises ValueError: if the observation has no graph, or an option is unknown
    """

    graph_keys: ClassVar[tuple[str, ...]] = (JOINT_KEY, KNOWN_KEY)

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *,
        n_hops: int = 16,
        hop_width: int = 16,
        head_arch: Sequence[int] = (),
        value_arch: Sequence[int] = (64, 32),
        critic_keys: Sequence[str] | None = None,
        norm_layer: str = "none",
        encoder: str = "convolutions",
        local_channels: Sequence[int] | None = None,
        joint_channels: Sequence[int] | None = None,
        state_channels: Sequence[int] | None = None,
        precision: str = "fp32",
        use_sde: bool = False,
        optimizer_class: type[th.optim.Optimizer] = th.optim.Adam,
        optimizer_kwargs: dict[str, Any] | None = None,
    ) -> None:
        known = observation_space.spaces if isinstance(observation_space, spaces.Dict) else {}
        missing = [key for key in (*self.graph_keys, POSITION_KEY) if key not in known]
        if missing:
            raise ValueError(
                f"{type(self).__name__} reads the key {missing[0]!r}, which this environment does "
                "not observe: give area search env_kwargs {known_map: true}"
            )
        if not isinstance(action_space, spaces.Discrete) or int(action_space.n) != N_ACTIONS:
            raise ValueError(f"{type(self).__name__} needs area search's {N_ACTIONS} moves")
        check_positive(n_hops=n_hops, hop_width=hop_width)
        self.n_hops, self.hop_width = n_hops, hop_width
        self._given: dict[str, Any] = {
            "head_arch": head_arch,
            "value_arch": value_arch,
            "critic_keys": critic_keys,
            "norm_layer": norm_layer,
            "encoder": encoder,
            "local_channels": local_channels,
            "joint_channels": joint_channels,
            "state_channels": state_channels,
            "precision": precision,
            "optimizer_class": optimizer_class,
            "optimizer_kwargs": optimizer_kwargs,
        }
        super().__init__(
            observation_space,
            action_space,
            lr_schedule,
            actor_keys=self.graph_keys,
            graph=False,
            actor_arch=(),
            use_sde=use_sde,
            **self._given,
        )

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "lr_schedule": self._dummy_schedule,
            "n_hops": self.n_hops,
            "hop_width": self.hop_width,
            **self._given,
        }

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        for key in self.graph_keys:
            # The graph is made from whole maps.
            self._map_readers.pop(key, None)
        self.message_passing.balance()

    def _build_networks(self) -> None:
        self.message_passing = MessagePassing(self.hop_width, self.n_hops)
        # An edge's embedding, from those of its two ends.
        self.decoder = mlp(2 * self.hop_width + 1, (self.hop_width,))
        self.action_net = Head(self._build_readout(), self.head_arch, 1, gain=0.01)
        size = self._add_encoders("value_primitive", self.critic_keys)
        self.value_net = Head(size, self.value_arch, 1, gain=1.0)  # type: ignore[assignment]
        self.action_dist = CategoricalDistribution(N_ACTIONS)

    @abstractmethod
    def _build_readout(self) -> int:
        """Create what :meth:`_readout` needs.

        :return: size of the features of an action
        """

    @abstractmethod
    def _readout(self, ends: th.Tensor) -> th.Tensor:
        """Combine the hops.

        :param ends: float (n, 6, n_hops + 1, width), embeddings of each robot and of the cells
            that its actions lead to
        :return: float (n, 5, features of an action)
        """

    def _decode(self, ends: th.Tensor) -> th.Tensor:
        """Embed the edges of actions.

        :param ends: float (n, 6, ..., width), each robot, and the cells that its actions lead to
        :return: float (n, 5, ..., width)
        """
        cells = ends[:, 1:]
        robots = ends[:, :1].expand_as(cells)
        lengths = th.ones_like(cells[..., :1])
        lengths[:, 0] = 0.0
        return self.decoder(th.cat([cells, robots, lengths], dim=-1))

    def team_graphs(self, obs: Observation) -> TeamGraphs:
        """Build the graphs of the teams in some rows.

        :param obs: tensors by key; maps of a team once, or once per robot
        :return: the graphs
        """
        n_agents = self.team_size(obs)
        position = obs[POSITION_KEY].view(-1, n_agents, 2)
        joint, known = (
            maps if len(maps) == len(position) else maps[::n_agents]
            for maps in (obs[JOINT_KEY], obs[KNOWN_KEY])
        )
        return build_graphs(known[:, _FREE], joint[:, _TARGET], joint[:, _FRONTIER], position)

    def _log_probs(self, obs: Observation, memo: dict[str, th.Tensor]) -> th.Tensor:
        graphs = self.team_graphs(obs)
        # The compiled loop is written in float32.
        with th.autocast(self.device.type, enabled=False):
            scores = self.action_net(self._readout(self.message_passing(graphs))).squeeze(-1)
        return F.log_softmax(scores.masked_fill(~graphs.open, LOG_ZERO), dim=1)


class GNNPolicy(GraphActorCriticPolicy):
    """The network of Tolstaya et al. (2021).

    Theirs: the graph and its features, one core applied hop after hop with mean aggregation, a
    decoder shared by the hops whose outputs are concatenated, a linear score per edge. Ours: that
    the decoder reads the two ends of an edge and its length, the sizes that they do not print, and
    the critic, which cloning does not train.

    :param options: see :class:`GraphActorCriticPolicy`
    """

    def _build_readout(self) -> int:
        return (self.n_hops + 1) * self.hop_width

    def _readout(self, ends: th.Tensor) -> th.Tensor:
        return self._decode(ends).flatten(2)


class H2GNNPolicy(GraphActorCriticPolicy):
    """Our reading of H2GNN (Zhang et al. 2022), whose code is not public.

    Theirs: that a node's embeddings after 0, 1, ..., H hops are weighted by multi-head attention,
    so that near and far are told apart. Ours: the graph (that of GNN), that a node's own embedding
    (hop 0) asks and its hops answer, and the score of an action from the attended embeddings of
    robot and cell; trained by MAPPO with the critic of the other policies.

    :param n_heads: heads of the attention
    :param options: see :class:`GraphActorCriticPolicy`
    :raises ValueError: if the heads do not divide the embedding
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        *,
        n_heads: int = 4,
        **options: Any,
    ) -> None:
        width = options.get("hop_width", 16)
        whole = isinstance(n_heads, int) and not isinstance(n_heads, bool) and n_heads >= 1
        if not whole or (isinstance(width, int) and width % n_heads):
            raise ValueError(f"n_heads must divide hop_width, {width}, got {n_heads!r}")
        self.n_heads = n_heads
        super().__init__(observation_space, action_space, lr_schedule, **options)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        return {**super()._get_constructor_parameters(), "n_heads": self.n_heads}

    def _build_readout(self) -> int:
        width = self.hop_width
        self.query = nn.Linear(width, width)
        self.answer = nn.Linear(width, 2 * width)
        self.attended = nn.Linear(width, width)
        return width

    def attend(self, hops: th.Tensor) -> th.Tensor:
        """Weight the hops of some nodes.

        :param hops: float (n, n_hops + 1, width)
        :return: float (n, width)
        """
        n, _, width = hops.shape
        query = self.query(hops[:, :1]).view(n, 1, self.n_heads, -1)
        keys, values = (
            self.answer(hops).view(n, -1, self.n_heads, 2 * width // self.n_heads).chunk(2, -1)
        )
        weights = ((query * keys).sum(-1) * query.shape[-1] ** -0.5).softmax(dim=1)
        return self.attended((weights.unsqueeze(-1) * values).sum(1).flatten(1))

    def _readout(self, ends: th.Tensor) -> th.Tensor:
        return self._decode(self.attend(ends.flatten(0, 1)).view(len(ends), 1 + N_ACTIONS, -1))
