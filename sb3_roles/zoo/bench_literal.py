"""The literal update of HMAPPO: what the fast one computes, written down as the equations say it.

Every robot has its own copy of every map; maps are float32 with channels first, and each robot's
are encoded by themselves; minibatches are rows of numpy arrays, as Stable-Baselines3 makes them;
concatenations are made. No module of the policy is called: only its weights are read, by name.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

import numpy as np
import torch as th
from torch.nn import functional as F

from sb3_roles.common.losses import stream_loss
from sb3_roles.common.policies import POSITION_KEY
from sb3_roles.common.role_wrapper import ROLE_DUE_KEY, ROLE_KEY
from sb3_roles.common.team_wrapper import AGENT_KEY
from sb3_roles.common.torch_layers import PatchEncoder, symlog
from sb3_roles.hmappo import HMAPPO
from sb3_roles.hmappo.policies import RoleActorCriticPolicy
from sb3_roles.zoo.bench_case import Work
from sb3_roles.zoo.options import UsageError

MAX_DIFFERENCE = 1.0e-5
Said = tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]
"""Log-probabilities of roles (n, n_roles) and moves (n, n_moves), values of both critics (n,)."""


class LiteralPolicy:
    """The forward pass of ``RoleActorCriticPolicy`` in float32, robot by robot (Section V).

    :param policy: gives the first weights, and the options of the networks
    :raises UsageError: if maps are not read as patches
    """

    def __init__(self, policy: RoleActorCriticPolicy) -> None:
        if not all(isinstance(encoder, PatchEncoder) for encoder in policy.encoders.values()):
            raise UsageError("the literal update reads maps as patches: set encoder to patches")
        self.policy = policy
        self.weights: dict[str, th.Tensor] = {}
        self.read()

    def read(self) -> None:
        """Take the weights that the policy has now."""
        self.weights = {
            name: weight.detach().clone().requires_grad_()
            for name, weight in self.policy.named_parameters()
        }

    def _linear(self, name: str, x: th.Tensor) -> th.Tensor:
        return F.linear(x, self.weights[f"{name}.weight"], self.weights.get(f"{name}.bias"))

    def _mlp(self, name: str, x: th.Tensor) -> th.Tensor:
        layer = 0
        while f"{name}.{layer}.weight" in self.weights:
            x = F.relu(self._linear(f"{name}.{layer}", x))
            layer += 2  # ReLUs have numbers, too
        return x

    def _head(self, name: str, x: th.Tensor) -> th.Tensor:
        return self._linear(f"{name}.out", self._mlp(f"{name}.hidden", x))

    def _encode_map(self, name: str, maps: th.Tensor) -> th.Tensor:
        encoder = self.policy.encoders[name]
        assert isinstance(encoder, PatchEncoder)
        patch, grid = encoder.patch, encoder.grid
        embed = self.weights[f"encoders.{name}.embed.weight"]
        # A dense layer on patches is a convolution that steps by whole patches.
        kernel = embed.view(len(embed), patch, patch, -1).permute(0, 3, 1, 2)
        maps = F.pad(maps, (0, -maps.shape[3] % patch, 0, -maps.shape[2] % patch))
        bias = self.weights[f"encoders.{name}.embed.bias"]
        embedded = F.relu(F.conv2d(maps, kernel, bias, stride=patch))
        if embedded.shape[2:] != (grid, grid):
            embedded = F.adaptive_avg_pool2d(embedded, grid)
        return self._mlp(f"encoders.{name}.mix", embedded.permute(0, 2, 3, 1).flatten(1))

    def _features(
        self, owner: str, keys: Sequence[str], rows: Mapping[str, th.Tensor], seen: dict[str, Any]
    ) -> th.Tensor:
        """Encode what a network reads; ``seen`` keeps what encoders that are shared have read."""
        spaces = self.policy.observation_space
        parts = []
        for key in keys:
            if len(spaces[key].shape or ()) != 3:
                values = rows[key].flatten(1)
                bounded = bool(np.isfinite(spaces[key].high).all())  # type: ignore[attr-defined]
                parts.append(values if bounded else symlog(values))
                continue
            shared = f"shared_{key}" if key in self.policy.actor_keys else f"value_{key}"
            name = shared if self.policy.share_encoders else f"{owner}_{key}"
            if name not in seen:
                seen[name] = self._encode_map(name, rows[key])
            parts.append(seen[name])
        return th.cat(parts, dim=1)

    def _role_head(self, name: str, x: th.Tensor, roles: th.Tensor) -> th.Tensor:
        """A head on features and a one-hot role (Section V-B)."""
        one_hot = F.one_hot(roles, self.policy.n_roles).float()
        parts = [self.weights[f"{name}.{part}.weight"] for part in ("features", "role")]
        bias = self.weights[f"{name}.features.bias"]
        first = F.linear(th.cat([x, one_hot], dim=1), th.cat(parts, dim=1), bias)
        return self._head(f"{name}.head", F.relu(first))

    def _messages(self, x: th.Tensor, rows: Mapping[str, th.Tensor]) -> th.Tensor:
        """ReLU(W0 x_i + W1 sum_j S_ij x_j) with S = D^-1/2 A D^-1/2, team by team."""
        n_agents = int(rows[AGENT_KEY][0, 1])
        position = rows[POSITION_KEY].view(-1, n_agents, 1, 2)
        radius = self.policy.communication_radius
        distance = (position - position.transpose(1, 2)).square().sum(3).sqrt()
        linked = (distance < (float("inf") if radius is None else radius)).float()
        linked = linked * (1.0 - th.eye(n_agents))
        degree = linked.sum(2).clamp(min=1.0)
        graph = linked / (degree.unsqueeze(2) * degree.unsqueeze(1)).sqrt()
        heard = (graph @ x.view(-1, n_agents, x.shape[1])).flatten(0, 1)
        return F.relu(self._linear("role_graph.own", x) + self._linear("role_graph.others", heard))

    def __call__(self, rows: Mapping[str, th.Tensor], actions: th.Tensor) -> Said:
        """Evaluate actions.

        :param rows: float32 tensors by key, (n, ...), each robot's own, maps with channels first
        :param actions: int64 (n, 2), role and move
        """
        policy, seen = self.policy, dict[str, Any]()
        roles = actions[:, 0]
        view = self._features("role", policy.actor_keys, rows, seen)
        if policy.see_role:
            view = th.cat([view, rows[ROLE_KEY]], dim=1)
        x = self._mlp("role_mlp", view)
        if policy.graph:
            x = self._messages(x, rows)
        chosen = F.log_softmax(self._head("role_net", x), dim=1)
        # A role that goes on has probability 1.
        goes_on = th.where(rows[ROLE_KEY] > 0.5, 0.0, -1.0e9)
        role_log_probs = th.where(rows[ROLE_DUE_KEY] > 0.5, chosen, goes_on)

        own = self._features("primitive", policy._move_keys, rows, seen)
        if policy.primitive_input == "graph":
            own = th.cat([own, x], dim=1)
        logits = self._role_head("action_net", own, roles)
        if policy.goal_key is not None:
            flags = rows[policy.goal_key][..., : policy.n_moves]
            weight = self.weights["goal_net.weights"][roles]
            logits = logits + (weight.unsqueeze(2) * flags).sum(1)

        state = self._features("value_role", policy.critic_keys, rows, seen)
        with_role = th.cat([state, rows[ROLE_KEY]], dim=1) if policy.see_role else state
        role_values = self._head("role_value_net", with_role).squeeze(1)
        state = self._features("value_primitive", policy.critic_keys, rows, seen)
        move_values = self._role_head("value_net", state, roles).squeeze(1)
        return role_log_probs, F.log_softmax(logits, dim=1), role_values, move_values


class LiteralUpdate:
    """Updates a copy of a model's weights on the model's last rollout.

    :param model: a trained or untrained HMAPPO whose rollout buffer is full
    """

    def __init__(self, model: HMAPPO) -> None:
        self.model = model
        self.policy = LiteralPolicy(model.policy)  # type: ignore[arg-type]
        self.optimizer: th.optim.Optimizer
        self.rows: dict[str, np.ndarray] = {}

    def load(self) -> None:
        """Copy rollout, weights and the state of the optimizer from the model."""
        buffer, model = self.model.rollout_buffer, self.model
        space = model.policy.observation_space
        self.samples = buffer.samples(th.arange(buffer.buffer_size * buffer.n_teams))
        self.rows = {
            key: self._of_robots(key, value).numpy()
            for key, value in self.samples.observations.items()
            # As the environment gives them, and as a stock buffer stores them.
            if key in space.spaces
        }
        self.policy.read()
        self.optimizer = th.optim.Adam(self.policy.weights.values())
        # It would take over the tensors themselves.
        self.optimizer.load_state_dict(deepcopy(model.policy.optimizer.state_dict()))

    def _of_robots(self, key: str, values: th.Tensor) -> th.Tensor:
        """Undo what ``prepare`` did, and give each robot its own copy."""
        policy = self.model.policy
        shape = policy.observation_space[key].shape or ()
        if len(shape) == 3 and values.ndim == 3:
            channels, height, width = shape
            # Patches of one size for all readers of a key.
            sizes = {
                (encoder.patch, encoder.grid)
                for name, encoder in policy.encoders.items()
                if name.endswith(f"_{key}") and isinstance(encoder, PatchEncoder)
            }
            ((patch, grid),) = sizes
            cells = values.view(-1, grid, grid, patch, patch, channels)
            side = grid * patch
            cells = cells.permute(0, 5, 1, 3, 2, 4).reshape(-1, channels, side, side)
            values = cells[:, :, :height, :width]
        n_rows = len(self.samples.actions)
        return values.repeat_interleave(n_rows // len(values), dim=0).contiguous()

    def _take(self, rows: np.ndarray) -> dict[str, th.Tensor]:
        return {key: th.as_tensor(array[rows]).float() for key, array in self.rows.items()}

    def difference(self, n_pairs: int = 64) -> float:
        """Compare with the fast forward pass in float32.

        :param n_pairs: (time, team) pairs to compare on, at most
        :return: the largest difference of a log-probability or value, relative for those above 1
        """
        policy, buffer = self.model.policy, self.model.rollout_buffer
        index = th.arange(min(n_pairs, buffer.buffer_size * buffer.n_teams))
        batch = buffer.samples(index)
        precision, policy.precision = policy.precision, "fp32"
        try:
            with th.no_grad():
                # Not as the policy's own attribute, which may be counting samples.
                fast = type(policy).streams(policy, batch.observations, batch.actions)
                literal = self.policy(self._take(np.arange(len(batch.actions))), batch.actions)
        finally:
            policy.precision = precision
        pairs = zip((*fast.log_probs, *fast.values.unbind(1)), literal, strict=True)
        return max(float(((a - b).abs() / a.abs().clamp(min=1.0)).max()) for a, b in pairs)

    def check(self) -> float:
        """Return :meth:`difference`, and refuse one that is no rounding.

        :raises UsageError: if it is not below 1e-5
        """
        found = self.difference()
        if not found < MAX_DIFFERENCE:
            raise UsageError(
                f"the literal forward pass differs by {found:.2g} from the fast one in fp32, "
                f"allowed is less than {MAX_DIFFERENCE:g}: nothing was measured"
            )
        return found

    def update(self) -> tuple[float, Work]:
        """Run all epochs, on the minibatches that the model's buffer draws.

        :return: seconds, and the work done
        """
        model, buffer = self.model, self.model.rollout_buffer
        n_agents, settings = buffer.n_agents, model._settings()
        n_steps = buffer.buffer_size * buffer.n_teams
        done = Work(n_steps, n_steps * n_agents)
        of_team = np.arange(n_agents)
        start = time.perf_counter()
        for _ in range(model.n_epochs):
            for index in buffer.pairs(model.batch_size):
                rows = (index.numpy()[:, None] * n_agents + of_team).ravel()
                take = th.as_tensor(rows)
                actions = self.samples.actions[take]
                *log_probs, role_values, move_values = self.policy(self._take(rows), actions)
                losses = [
                    stream_loss(
                        log_probs[s],
                        values,
                        actions[:, s],
                        self.samples.old_log_probs[s][take],
                        self.samples.advantages[take, s],
                        self.samples.returns[take, s],
                        self.samples.active[take, s],
                        settings[s].clip_range,
                        settings[s].ent_coef,
                        settings[s].vf_coef,
                        model.kl_coefs[s],
                    ).loss
                    for s, values in enumerate((role_values, move_values))
                ]
                self.optimizer.zero_grad()
                th.stack(losses).sum().backward()
                limit = float("inf") if model.max_grad_norm is None else model.max_grad_norm
                th.nn.utils.clip_grad_norm_(self.policy.weights.values(), limit)
                self.optimizer.step()
                done.samples_times_epochs += len(rows)
                done.optimizer_steps += 1
        return time.perf_counter() - start, done
