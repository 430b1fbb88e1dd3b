"""``TeamRolloutBuffer``: rollouts whose minibatches keep teams together."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from typing import Any, NamedTuple

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictRolloutBuffer
from stable_baselines3.common.type_aliases import DictRolloutBufferSamples

from sb3_roles.common.losses import lambda_returns
from sb3_roles.common.not_finite import NotFiniteError
from sb3_roles.common.observation_store import ObservationStore, take_groups
from sb3_roles.common.policies import Streams
from sb3_roles.common.team_wrapper import AGENT_KEY


class TeamSamples(NamedTuple):
    """A minibatch of whole teams; n rows, S streams, K_s choices in a stream."""

    observations: dict[str, th.Tensor]
    actions: th.Tensor
    """int64 (n, S)"""
    old_log_probs: tuple[th.Tensor, ...]
    """per stream float (n, K_s)"""
    advantages: th.Tensor
    """float (n, S)"""
    returns: th.Tensor
    """float (n, S)"""
    active: th.Tensor
    """bool (n, S)"""


class TeamRolloutBuffer(DictRolloutBuffer):
    """On-policy rollouts of teams, as tensors on the training device.

    Minibatches are permutations of (time, team) pairs: the rows of a team stay together and in
    order, which the graph and the team-level maps need. What a team shares is stored once per team
    when it is given once per team, and maps of 0 and 1 as bits. Stock PPO, A2C, TRPO and
    MaskablePPO take it as ``rollout_buffer_class``; MAPPO and HMAPPO use its streams.

    :param buffer_size: steps per rollout
    :param observation_space: of one row, with the key ``agent``
    :param action_space: of one row
    :param device: where the tensors are
    :param gae_lambda: for stock algorithms
    :param gamma: for stock algorithms
    :param n_envs: rows
    :ivar taken: int64 (b,), the pairs of the minibatch that :meth:`get` returned last
    """

    observation_space: spaces.Dict
    taken: th.Tensor | None

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Dict,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        gae_lambda: float = 1.0,
        gamma: float = 0.99,
        n_envs: int = 1,
    ) -> None:
        if AGENT_KEY not in observation_space.spaces:
            raise ValueError(
                f"TeamRolloutBuffer needs the observation key {AGENT_KEY!r}: wrap the environment "
                "in TeamWrapper or RoleWrapper"
            )
        self._stores: dict[str, ObservationStore] = {}
        self._layout: tuple[Any, ...] = ()
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device,
            gae_lambda=gae_lambda,
            gamma=gamma,
            n_envs=n_envs,
        )

    def reset(self) -> None:
        """Forget the rollout; memory is kept, and allocated at the first use."""
        self.pos = 0
        self.full = False
        self.generator_ready = False
        self.taken = None

    def _allocate_for(self, observations: Mapping[str, th.Tensor], chosen: Streams) -> None:
        """Allocate, unless the last rollout had the same shapes: the teams may have changed."""
        n_agents = int(observations[AGENT_KEY][0, 1])
        shapes = {key: (value.shape, value.dtype) for key, value in observations.items()}
        layout = (self.n_envs, n_agents, chosen.actions.shape[1], shapes)
        if layout != self._layout:
            self._layout = layout
            self.n_agents, self.n_teams = n_agents, self.n_envs // n_agents
            self._allocate(observations, chosen)

    def _allocate(self, observations: Mapping[str, th.Tensor], chosen: Streams) -> None:
        self._stores = {
            key: ObservationStore(self.buffer_size, value, self.observation_space[key])
            for key, value in observations.items()
        }
        n_streams = chosen.actions.shape[1]

        def rows(*shape: int, dtype: th.dtype = th.float32) -> th.Tensor:
            size = (self.buffer_size, self.n_envs, *shape)
            return th.zeros(size, dtype=dtype, device=self.device)

        self._actions = rows(n_streams, dtype=th.int64)
        self._active = rows(n_streams, dtype=th.bool)
        self._rewards = rows(n_streams)
        self._values = rows(n_streams)
        self._expected_values = rows(n_streams)
        self._returns = rows(n_streams)
        self._advantages = rows(n_streams)
        self._ends = rows(dtype=th.bool)
        self._log_probs = [rows(log_probs.shape[1]) for log_probs in chosen.log_probs]
        # Of stock algorithms, which know only the action's log-probability.
        self._joint_log_prob = rows()

    def add_streams(
        self,
        observations: Mapping[str, th.Tensor],
        chosen: Streams,
        rewards: th.Tensor,
        ends: th.Tensor,
    ) -> None:
        """Add one step of all teams.

        :param observations: what the policy saw
        :param chosen: what it said
        :param rewards: float (n, S); with the value at a truncation already added
        :param ends: bool (n,), whether the episode ended with this step
        """
        if self.pos == 0:
            self._allocate_for(observations, chosen)
        t = self.pos
        for key, store in self._stores.items():
            store.put(t, observations[key])
        self._actions[t] = chosen.actions
        self._active[t] = chosen.active
        self._rewards[t] = rewards
        self._values[t] = chosen.values
        self._expected_values[t] = chosen.expected_values
        self._ends[t] = ends
        for memory, log_probs in zip(self._log_probs, chosen.log_probs, strict=True):
            memory[t] = log_probs
        self.pos += 1
        self.full = self.pos == self.buffer_size

    def compute_stream_returns(
        self,
        last_expected_values: th.Tensor,
        gamma: th.Tensor,
        gae_lambda: th.Tensor,
        normalize_advantage: bool,
    ) -> None:
        """Compute returns and advantages of every stream.

        :param last_expected_values: float (n, S), after the last step
        :param gamma: float (S,)
        :param gae_lambda: float (S,)
        :param normalize_advantage: to mean 0 and deviation 1 over the rows in which a stream
            decided, per stream
        :raises NotFiniteError: if a return or an advantage is not finite
        """
        self._returns = lambda_returns(
            self._rewards,
            self._expected_values,
            last_expected_values,
            self._ends,
            gamma,
            gae_lambda,
        )
        self._check("return", self._returns)
        self._advantages = self._returns - self._values
        if normalize_advantage:
            for s in range(self._advantages.shape[2]):
                used = self._advantages[..., s][self._active[..., s]]
                if len(used) > 1:
                    scaled = (self._advantages[..., s] - used.mean()) / (used.std() + 1e-8)
                    self._advantages[..., s] = scaled
        self._check("advantage", self._advantages)

    def _check(self, part: str, values: th.Tensor) -> None:
        """Refuse returns or advantages that are not finite, float (T, n, S)."""
        found = th.isfinite(values)
        if found.all():
            return
        t, row, stream = (~found).nonzero()[0].tolist()
        team, agent = divmod(row, self.n_agents)
        names = ("rewards", "values", "expected_values", "returns", "advantages", "ends")
        raise NotFiniteError(
            part,
            f"the {part} of stream {stream} is {values[t, row, stream].item()} in step {t} of the "
            f"rollout, team {team}, robot {agent}: check the environment's rewards and the "
            "critics' values; nothing was learned from this rollout",
            {name: getattr(self, f"_{name}") for name in names},
        )

    def _take(self, memory: th.Tensor, index: th.Tensor) -> th.Tensor:
        return take_groups(memory, index, self.n_agents)

    def _observations_at(self, index: th.Tensor) -> dict[str, th.Tensor]:
        return {key: store.take(index, self.n_teams) for key, store in self._stores.items()}

    def minibatches(self, batch_teams: int) -> Generator[TeamSamples, None, None]:
        """Go once through the rollout, in a random order of (time, team) pairs.

        :param batch_teams: pairs, that is, joint steps, per minibatch
        """
        for index in self.pairs(batch_teams):
            yield self.samples(index)

    def pairs(self, batch_teams: int | None) -> Generator[th.Tensor, None, None]:
        """Number the (time, team) pairs of minibatches, in a random order.

        :param batch_teams: pairs per minibatch; None for all at once
        :return: int64 (at most batch_teams,), see :meth:`samples`
        """
        n = self.buffer_size * self.n_teams
        # Drawn on the CPU: the same permutations on every device.
        permutation = th.randperm(n).to(self.device)
        for start in range(0, n, batch_teams or n):
            yield permutation[start : start + (batch_teams or n)]

    def samples(self, index: th.Tensor) -> TeamSamples:
        """Gather (time, team) pairs.

        :param index: int64 (b,), of :meth:`pairs`
        """
        return TeamSamples(
            self._observations_at(index),
            self._take(self._actions, index),
            tuple(self._take(memory, index) for memory in self._log_probs),
            self._take(self._advantages, index),
            self._take(self._returns, index),
            self._take(self._active, index),
        )

    def named(self, index: th.Tensor) -> dict[str, th.Tensor]:
        """Return a minibatch as tensors by name, rows first, to be written to a file.

        :param index: int64 (b,), of :meth:`pairs`
        """
        batch = self.samples(index)
        by_name = {f"observations.{key}": value for key, value in batch.observations.items()}
        by_name |= {f"old_log_probs.{s}": value for s, value in enumerate(batch.old_log_probs)}
        rest = ("actions", "advantages", "returns", "active")
        return by_name | {name: getattr(batch, name) for name in rest}

    def n_active(self, index: th.Tensor) -> list[float]:
        """Count the rows of some pairs in which each stream decided."""
        counts: list[float] = self._take(self._active, index).sum(0).tolist()
        return counts

    def spread_observations(self, most_teams: int) -> dict[str, th.Tensor]:
        """Take observations that are spread evenly over the rollout, without random numbers.

        :param most_teams: (time, team) pairs to take at most
        :return: tensors by key, rows of whole teams
        """
        n = self.buffer_size * self.n_teams
        return self._observations_at(th.arange(0, n, -(-n // most_teams), device=self.device))

    # The interface of Stable-Baselines3's buffers

    def add(  # type: ignore[override]
        self,
        obs: Mapping[str, np.ndarray],
        action: np.ndarray,
        reward: np.ndarray,
        episode_start: np.ndarray,
        value: th.Tensor,
        log_prob: th.Tensor,
    ) -> None:
        """Add one step; see ``RolloutBuffer.add``. Rows of all teams, in order."""
        tensors = {
            key: th.as_tensor(np.asarray(array)).to(self.device) for key, array in obs.items()
        }
        flat = th.as_tensor(action, device=self.device).view(self.n_envs, -1).long()
        column = value.detach().view(-1, 1)
        chosen = Streams(flat, (), column, column, th.ones_like(flat, dtype=th.bool))
        if self.pos == 0:
            self._allocate_for(tensors, chosen)
            self._rewards, self._values = self._rewards[..., :1], self._values[..., :1]
            self._expected_values = self._expected_values[..., :1]
        if self.pos:
            self._ends[self.pos - 1] = th.as_tensor(episode_start, device=self.device) > 0
        t = self.pos
        self._joint_log_prob[t] = log_prob.detach()
        ends = th.zeros(self.n_envs, dtype=th.bool, device=self.device)
        rewards = th.as_tensor(reward, device=self.device, dtype=th.float32).view(-1, 1)
        self.add_streams(tensors, chosen, rewards, ends)

    def compute_returns_and_advantage(self, last_values: th.Tensor, dones: np.ndarray) -> None:
        """Compute returns and advantages; see ``RolloutBuffer``."""
        self._ends[self.pos - 1] = th.as_tensor(dones, device=self.device)
        gamma, gae_lambda = (
            th.tensor([x], dtype=th.float32, device=self.device)
            for x in (self.gamma, self.gae_lambda)
        )
        last = last_values.detach().view(-1, 1)
        self.compute_stream_returns(last, gamma, gae_lambda, normalize_advantage=False)

    def get(  # type: ignore[override]
        self, batch_size: int | None = None
    ) -> Generator[DictRolloutBufferSamples, None, None]:
        """Go once through the rollout.

        :param batch_size: rows per minibatch, rounded down to whole teams; None for all
        """
        assert self.full, "the rollout is not complete"
        teams = None if batch_size is None else max(1, batch_size // self.n_agents)
        for index in self.pairs(teams):
            self.taken = index
            yield DictRolloutBufferSamples(
                observations=self._observations_at(index),
                actions=self._take(self._actions, index),
                old_values=self._take(self._values, index).flatten(),
                old_log_prob=self._take(self._joint_log_prob, index),
                advantages=self._take(self._advantages, index).flatten(),
                returns=self._take(self._returns, index).flatten(),
            )

    def _first_stream(self, memory: th.Tensor) -> np.ndarray:
        return memory[..., 0].cpu().numpy()

    def stream_arrays(self, stream: int) -> tuple[np.ndarray, np.ndarray]:
        """Return values and returns of one stream, float32 (T, n) each."""
        arrays = (self._values[..., stream], self._returns[..., stream])
        return arrays[0].cpu().numpy(), arrays[1].cpu().numpy()

    # DictRolloutBuffer has these as attributes, which stock algorithms read.
    @property
    def values(self) -> Any:  # type: ignore[override]
        """Values of the first stream, float32 (T, n)."""
        return self._first_stream(self._values)

    @property
    def returns(self) -> Any:  # type: ignore[override]
        """Returns of the first stream, float32 (T, n)."""
        return self._first_stream(self._returns)

    @property
    def nbytes(self) -> int:
        """Bytes of memory that hold observations."""
        return sum(store.memory.nbytes for store in self._stores.values())
