"""MAPPO: PPO for teams, with central critics and an exact, adaptive KL penalty."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, explained_variance
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.common.buffers import TeamRolloutBuffer
from sb3_roles.common.checks import check_not_negative, check_positive, check_trusted, check_unit
from sb3_roles.common.losses import StreamLoss, adapt_kl_coef, check_same_policy, stream_loss
from sb3_roles.common.names import closest
from sb3_roles.common.not_finite import NotFiniteError, check_loss, gradient_error
from sb3_roles.common.policies import TeamPolicy
from sb3_roles.common.rollout_steps import LocalPlayer, RolloutPlayer
from sb3_roles.common.rollouts import make_groups, split_teams
from sb3_roles.common.shards import (
    Gradients,
    add_gradients,
    set_gradients,
    shards_of,
    trainable,
)
from sb3_roles.common.team_wrapper import AGENT_KEY, TeamWrapper, find_team_env
from sb3_roles.common.threads import ThreadCrew
from sb3_roles.common.torch_layers import updating_statistics
from sb3_roles.mappo.policies import TeamActorCriticPolicy

SelfMAPPO = TypeVar("SelfMAPPO", bound="MAPPO")


class StreamSettings(NamedTuple):
    """The coefficients of one stream, at one point of training."""

    gamma: float
    gae_lambda: float
    clip_range: float
    ent_coef: float
    vf_coef: float


class MAPPO(OnPolicyAlgorithm):
    """Multi-agent PPO with shared parameters, decentralized actors and central critics (CTDE).

    The loss is L = L_CLIP + c1 L_KL + c2 L_VF + c3 L_E (Eq. 8); L_KL is the exact divergence from
    the policy that acted, and its coefficient adapts as RLlib's does. Schedules are functions of
    the progress that remains, from 1 to 0.

    :param policy: ``"TeamPolicy"``, or a subclass of ``TeamPolicy``
    :param env: an environment of ``make_team_vec_env``, possibly wrapped
    :param learning_rate: of Adam; a number or a schedule
    :param n_steps: joint steps per team and rollout
    :param batch_size: joint steps (of one team each) per minibatch
    :param n_epochs: passes over a rollout
    :param gamma: discount
    :param gae_lambda: lambda of the TD(lambda) returns
    :param clip_range: epsilon of the clipped surrogate; a number or a schedule
    :param normalize_advantage: over each rollout
    :param ent_coef: coefficient of the entropy bonus; a number or a schedule
    :param vf_coef: coefficient of the squared value error
    :param kl_coef: first coefficient of the KL penalty; 0 switches it off
    :param kl_target: the divergence per update, in nats, that the coefficient adapts to
    :param max_grad_norm: gradients are clipped to this norm; None does not clip
    :param n_shards: parts of a minibatch whose gradients are computed side by side, each on threads
        of its own, and added; their number moves results by rounding
    :param rollout_groups: groups of teams that the policy acts for side by side, each on a thread
        and with random numbers of its own; with more than one, rollouts do not depend on the number
        of threads
    :param target_kl: stop the epochs of an update when a minibatch diverges by more than 1.5 times
        this; None never
    :param policy_kwargs: arguments of the policy
    :param stats_window_size: episodes over which ``rollout/`` averages
    :param tensorboard_log: folder for TensorBoard
    :param verbose: 0, 1 or 2
    :param seed: of the policy, the minibatches and the environment
    :param device: where to train
    :raises ValueError: if a parameter is out of range, or the environment has no teams
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"TeamPolicy": TeamActorCriticPolicy}
    policy: TeamPolicy
    rollout_buffer: TeamRolloutBuffer
    wrapper_class: ClassVar[type[TeamWrapper]] = TeamWrapper

    def __init__(
        self,
        policy: str | type[TeamPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 5e-4,
        n_steps: int = 50,
        batch_size: int = 1000,
        n_epochs: int = 5,
        gamma: float = 0.95,
        gae_lambda: float = 0.95,
        clip_range: float | Schedule = 0.2,
        normalize_advantage: bool = True,
        ent_coef: float | Schedule = 0.01,
        vf_coef: float = 0.5,
        kl_coef: float = 0.0,
        kl_target: float = 0.01,
        max_grad_norm: float | None = 0.5,
        n_shards: int = 1,
        rollout_groups: int = 1,
        target_kl: float | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            gamma=gamma,
            gae_lambda=gae_lambda,
            ent_coef=ent_coef,  # type: ignore[arg-type]
            vf_coef=vf_coef,
            max_grad_norm=max_grad_norm,  # type: ignore[arg-type]
            use_sde=False,
            sde_sample_freq=-1,
            rollout_buffer_class=TeamRolloutBuffer,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            monitor_wrapper=False,
            policy_kwargs=policy_kwargs,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=False,
            supported_action_spaces=(spaces.Discrete, spaces.MultiDiscrete),
        )
        self.batch_size = batch_size
        self.n_epochs = n_epochs
        self.clip_range = clip_range
        self.normalize_advantage = normalize_advantage
        self.kl_coef = kl_coef
        self.kl_target = kl_target
        self.n_shards = n_shards
        self.rollout_groups = rollout_groups
        self.target_kl = target_kl
        self.kl_coefs: list[float] = []
        self.player: RolloutPlayer = LocalPlayer(self)
        check_positive(n_steps=n_steps, batch_size=batch_size, n_epochs=n_epochs)
        check_positive(n_shards=n_shards, rollout_groups=rollout_groups)
        check_unit(gamma=gamma, gae_lambda=gae_lambda)
        check_not_negative(vf_coef=vf_coef, kl_coef=kl_coef, kl_target=kl_target)
        for name, value in (("max_grad_norm", max_grad_norm), ("target_kl", target_kl)):
            number = isinstance(value, (int, float)) and not isinstance(value, bool)
            if value is not None and not (number and value > 0):
                raise ValueError(f"{name} must be a number above 0 or None, got {value!r}")
        for name, schedule in (
            ("learning_rate", learning_rate),
            ("clip_range", clip_range),
            ("ent_coef", ent_coef),
        ):
            if not callable(schedule):
                check_not_negative(**{name: schedule})
        if _init_setup_model:
            self._setup_model()

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(closest("policy", policy_name, self.policy_aliases))
        return super()._get_policy_from_name(policy_name)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "player"]

    @classmethod
    def load(
        cls: type[SelfMAPPO],
        path: str | Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        *args: Any,
        trust: bool = False,
        **kwargs: Any,
    ) -> SelfMAPPO:
        """Load what SB3's ``save`` wrote; see ``BaseAlgorithm.load``.

        :param path: the zip
        :param env: to train on
        :param args: see ``BaseAlgorithm.load``
        :param trust: must be true: the zip holds pickles, which run whatever code they name
        :param kwargs: see ``BaseAlgorithm.load``
        :raises ValueError: if ``trust`` is not given
        """
        check_trusted(f"{cls.__name__}.load", path, trust)
        return super().load(path, env, *args, **kwargs)

    @classmethod
    def _wrap_env(cls, env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        # Also called by load() and set_env(), with whatever environment the user has.
        if not isinstance(env, VecEnv):
            raise ValueError(
                f"{cls.__name__} trains teams: make the environment with make_team_vec_env, "
                f"got {type(env).__name__}"
            )
        find_team_env(env)
        space = env.observation_space
        wrapped = isinstance(space, spaces.Dict) and AGENT_KEY in space.spaces
        return env if wrapped else cls.wrapper_class(env)

    def _setup_model(self) -> None:
        if self.env is not None:
            split_teams(find_team_env(self.env).n_teams, self.rollout_groups)
        super()._setup_model()
        self.clip_schedule = FloatSchedule(self.clip_range)
        self.ent_schedule = FloatSchedule(self.ent_coef)
        if not self.kl_coefs:
            self.kl_coefs = self._initial_kl_coefs()

    def _initial_kl_coefs(self) -> list[float]:
        return [self.kl_coef]

    def _settings(self) -> list[StreamSettings]:
        """Coefficients of each stream now, in the order of ``policy.stream_names``."""
        progress = self._current_progress_remaining
        return [
            StreamSettings(
                self.gamma,
                self.gae_lambda,
                self.clip_schedule(progress),
                self.ent_schedule(progress),
                self.vf_coef,
            )
        ]

    def discounts(self) -> th.Tensor:
        """Return the discount of each stream, float32 (S,)."""
        return th.tensor([stream.gamma for stream in self._settings()], device=self.device)

    def stream_rewards(self, env: VecEnv, rewards: np.ndarray) -> np.ndarray:
        """Return the rewards of each stream in the last step.

        :param env: the environment
        :param rewards: float32 (n,), what its step returned
        :return: float32 (n, S)
        """
        return rewards[:, None]

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """Turn choices into the environment's actions.

        :param actions: int64 (n, S)
        """
        return actions[:, 0]

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Play ``n_rollout_steps`` joint steps in every team.

        :return: False if a callback asked to stop
        """
        assert isinstance(rollout_buffer, TeamRolloutBuffer)
        assert self._last_obs is not None, "no previous observation was provided"
        last_obs: Any = self._last_obs
        self.policy.set_training_mode(False)
        rollout_buffer.reset()
        callback.on_rollout_start()
        team_env = find_team_env(env)
        groups = make_groups(team_env.n_teams, team_env.n_agents, self.rollout_groups)
        with self.player.play(env, groups, last_obs, n_rollout_steps) as rollout:
            for step in rollout.steps:
                # By these names callbacks find them, as those of SB3's algorithms.
                obs, chosen, actions, new_obs, rewards, dones, infos, stream_rewards = step
                self.num_timesteps += env.num_envs
                callback.update_locals(locals())
                if not callback.on_step():
                    return False
                self._update_info_buffer(infos, dones)
                ends = th.as_tensor(dones).to(self.device)
                rollout_buffer.add_streams(obs, chosen, stream_rewards, ends)
                self._last_obs = new_obs
                self._last_episode_starts = dones
            last_values = rollout.last_values()
        settings = self._settings()
        rollout_buffer.compute_stream_returns(
            last_values,
            self.discounts(),
            th.tensor([s.gae_lambda for s in settings], device=self.device),
            self.normalize_advantage,
        )
        callback.update_locals(locals())
        callback.on_rollout_end()
        return True

    def _update_info_buffer(
        self, infos: list[dict[str, Any]], dones: np.ndarray | None = None
    ) -> None:
        # SB3's loop, over the few rows that have anything to say.
        rows = [row for row, info in enumerate(infos) if info]
        if rows:
            ended = None if dones is None else dones[rows]
            super()._update_info_buffer([infos[row] for row in rows], ended)

    def train(self) -> None:
        """Update the policy on the rollout."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        settings = self._settings()
        history: list[list[StreamLoss]] = [[] for _ in settings]
        n_steps = 0
        stopped = False
        with ThreadCrew(self.n_shards, self.device) as crew:
            for _ in range(self.n_epochs):
                for index in self.rollout_buffer.pairs(self.batch_size):
                    losses, gradients = self._differentiate(index, settings, crew)
                    if n_steps == 0:
                        check_same_policy(self.policy.stream_names, losses)
                    for records, loss in zip(history, losses, strict=True):
                        records.append(loss)
                    if self._too_far(losses):
                        stopped = True
                        break
                    # L = L_p + L_r (Eq. 9)
                    try:
                        self._optimize(th.stack([part.loss for part in losses]).sum(), gradients)
                    except NotFiniteError as error:
                        where = f"minibatch {n_steps + 1} of update {self._n_updates + 1}"
                        raise error.found_in(where, self.rollout_buffer.named(index)) from None
                    n_steps += 1
                self._n_updates += 1
                if stopped:
                    break
        self._update_statistics()
        self._log_update(history, n_steps)
        for s, records in enumerate(history):
            if self.kl_coefs[s] > 0:
                kl = float(th.stack([record.kl for record in records]).mean())
                self.kl_coefs[s] = adapt_kl_coef(self.kl_coefs[s], kl, self.kl_target)

    def _too_far(self, losses: list[StreamLoss]) -> bool:
        """Whether to stop the epochs."""
        if self.target_kl is None:
            return False
        return sum(float(loss.kl) for loss in losses) > 1.5 * self.target_kl

    def _differentiate(
        self, index: th.Tensor, settings: list[StreamSettings], crew: ThreadCrew
    ) -> tuple[list[StreamLoss], list[th.Tensor | None]]:
        """Compute the loss of a minibatch and its gradients, shard by shard.

        :param index: (time, team) pairs of the rollout
        :return: per stream the loss, detached; per parameter that is not frozen the gradient
        """
        n_active = self.rollout_buffer.n_active(index)
        n_rows = len(index) * self.rollout_buffer.n_agents
        parameters = trainable(self.policy)

        def of_shard(pairs: th.Tensor) -> tuple[list[StreamLoss], Gradients]:
            batch = self.rollout_buffer.samples(pairs)
            now = self.policy.streams(batch.observations, batch.actions)
            losses = [
                stream_loss(
                    now.log_probs[s],
                    now.values[:, s],
                    batch.actions[:, s],
                    batch.old_log_probs[s],
                    batch.advantages[:, s],
                    batch.returns[:, s],
                    batch.active[:, s],
                    stream.clip_range,
                    stream.ent_coef,
                    stream.vf_coef,
                    self.kl_coefs[s],
                    n_active[s],
                    n_rows,
                )
                for s, stream in enumerate(settings)
            ]
            total = th.stack([part.loss for part in losses]).sum()
            gradients = th.autograd.grad(total, parameters, allow_unused=True)
            return [StreamLoss(*(term.detach() for term in part)) for part in losses], gradients

        parts = crew.map(of_shard, shards_of(index, self.n_shards))
        losses = [
            StreamLoss(*(th.stack(terms).sum() for terms in zip(*of_stream, strict=True)))
            for of_stream in zip(*(losses for losses, _ in parts), strict=True)
        ]
        return losses, add_gradients([gradients for _, gradients in parts])

    def _update_statistics(self) -> None:
        """Let frozen normalization layers see the rollout, between an update and the next one."""
        with updating_statistics(self.policy) as has_statistics, th.no_grad():
            if has_statistics:
                # Without gradients this many rows cost little.
                obs = self.rollout_buffer.spread_observations(max(2, self.batch_size))
                self.policy.streams(obs, deterministic=True)

    def _optimize(self, loss: th.Tensor, gradients: Gradients) -> None:
        """Take one step, unless it would destroy the weights.

        :raises NotFiniteError: if the loss or a gradient is not finite
        """
        check_loss(loss)
        set_gradients(trainable(self.policy), gradients)
        limit = float("inf") if self.max_grad_norm is None else self.max_grad_norm
        try:
            # The sum of squares, which is computed to clip anyway, tells it.
            th.nn.utils.clip_grad_norm_(self.policy.parameters(), limit, error_if_nonfinite=True)
        except RuntimeError as error:
            if "non-finite" not in str(error):
                raise
            raise gradient_error(self.policy) from error
        self.policy.optimizer.step()

    def _log_update(self, history: list[list[StreamLoss]], n_steps: int) -> None:
        names = self.policy.stream_names
        for s, (name, records) in enumerate(zip(names, history, strict=True)):
            prefix = f"train/{name}_" if len(names) > 1 else "train/"
            for field in StreamLoss._fields:
                terms = th.stack([getattr(record, field) for record in records])
                self.logger.record(prefix + field, float(terms.mean()))
            values, returns = self.rollout_buffer.stream_arrays(s)
            variance = explained_variance(values.flatten(), returns.flatten())
            self.logger.record(prefix + "explained_variance", float(variance))
            if self.kl_coefs[s] > 0:
                self.logger.record(prefix + "kl_coef", self.kl_coefs[s])
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/optimizer_steps", n_steps, exclude="tensorboard")

    def learn(
        self: SelfMAPPO,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 1,
        tb_log_name: str = "MAPPO",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfMAPPO:
        """Learn for a number of robot steps (joint steps times robots), as SB3 counts.

        See ``OnPolicyAlgorithm.learn``.
        """
        return super().learn(
            total_timesteps=total_timesteps,
            callback=callback,
            log_interval=log_interval,
            tb_log_name=tb_log_name,
            reset_num_timesteps=reset_num_timesteps,
            progress_bar=progress_bar,
        )
