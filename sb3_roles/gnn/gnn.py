"""GNN: behavior cloning of demonstrations on the team's graph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import obs_as_tensor, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.baselines.area import area_scene
from sb3_roles.common.checks import check_not_negative, check_positive, check_unit
from sb3_roles.common.distributions import LOG_ZERO
from sb3_roles.common.names import one_line
from sb3_roles.common.not_finite import NotFiniteError
from sb3_roles.common.policies import TeamPolicy
from sb3_roles.common.shards import trainable
from sb3_roles.gnn.demonstrations import DemonstrationError
from sb3_roles.gnn.joint_steps import JointSteps, batches, moved
from sb3_roles.gnn.policies import GNNPolicy
from sb3_roles.gnn.source import (
    check_recording,
    describe,
    obtain,
    summary,
    validation_episodes,
)
from sb3_roles.gnn.state import CloningState, check_same_demonstrations, plain_state, read_state
from sb3_roles.mappo.mappo import MAPPO

DEMONSTRATIONS_FILE = "demonstrations.npz"
# Joint steps of a forward pass that needs no gradient.
_VALIDATION_BATCH = 256
_SPLIT, _ORDER = 1, 2


class GNN(MAPPO):
    """Behavior cloning, in the frame of MAPPO: the same teams, policies and checks.

    An iteration plays ``n_steps`` joint steps in every team with the likeliest moves, which shows
    what was learned and teaches nothing, and then goes once through the demonstrations. So an epoch
    is ``n_steps * n_envs`` joint steps of the run's time. Training ends early when the loss on the
    validation episodes has not improved for ``patience`` epochs; at the end, early or not, the
    policy has the weights of the epoch with the lowest one.

    The paper's (Tolstaya et al. 2021): cross-entropy, Adam with 1e-3 times 0.95 for every 200
    updates, batches of 32 joint steps, 100 epochs over 200 recorded episodes, 70 % of them for
    training, the likeliest move at test. Ours: the patience, and that nothing is recorded twice:
    without a file the demonstrations are recorded first, into the folder of the logs if there is
    one. The policy's critic is not trained; MAPPO can go on from the actor.

    :param policy: ``"GNNPolicy"``, or another policy for single moves, which must find what it
        reads in demonstrations: ``known``, ``joint``, ``position``
    :param env: an environment of ``make_team_vec_env``, possibly wrapped
    :param demonstrations: a file of ``sb3-roles demonstrate``; None records them in the scene of
        ``env``, which must be area search then
    :param controller: whom to record then
    :param n_demonstrations: episodes to learn from: the first ones of the file
    :param validation_share: share of the episodes that are kept for validation
    :param learning_rate: of Adam, at first
    :param lr_decay: what the learning rate is multiplied by
    :param lr_decay_every: after how many updates
    :param batch_size: joint steps per update
    :param patience: epochs without a better validation loss after which to stop; None for never
    :param n_steps: joint steps per team that are played between two epochs
    :param policy_kwargs: arguments of the policy
    :param stats_window_size: episodes over which ``rollout/`` averages
    :param tensorboard_log: folder for TensorBoard
    :param verbose: 0, 1 or 2
    :param seed: of the policy, the order of the demonstrations, their recording and the environment
    :param device: where to train
    :raises ValueError: if a parameter is out of range, or the environment has no teams
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"GNNPolicy": GNNPolicy}

    def __init__(
        self,
        policy: str | type[TeamPolicy],
        env: GymEnv | str,
        demonstrations: str | None = None,
        controller: str = "planner",
        n_demonstrations: int = 200,
        validation_share: float = 0.3,
        learning_rate: float = 1e-3,
        lr_decay: float = 0.95,
        lr_decay_every: int = 200,
        batch_size: int = 32,
        patience: int | None = 15,
        n_steps: int = 50,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
    ) -> None:
        check_positive(lr_decay_every=lr_decay_every, n_demonstrations=n_demonstrations)
        check_unit(validation_share=validation_share, lr_decay=lr_decay)
        check_not_negative(learning_rate=learning_rate)
        if patience is not None:
            check_positive(patience=patience)
        self.demonstrations = demonstrations
        self.controller = controller
        self.n_demonstrations = n_demonstrations
        self.validation_share = validation_share
        self.lr_decay, self.lr_decay_every = lr_decay, lr_decay_every
        self.patience = patience
        self.epochs = 0
        self.best_epoch, self.best_loss = 0, float("inf")
        self.best_weights: dict[str, th.Tensor] = {}
        self._data: tuple[JointSteps, JointSteps] | None = None
        self.facts: dict[str, Any] = {}
        super().__init__(
            policy,
            env,
            learning_rate=learning_rate,
            n_steps=n_steps,
            batch_size=batch_size,
            max_grad_norm=None,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            _init_setup_model=_init_setup_model,
        )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_data"]

    @property
    def finished(self) -> bool:
        """Whether the validation loss has not improved for long enough."""
        return self.patience is not None and self.epochs - self.best_epoch >= self.patience

    # Demonstrations

    def check_data(self) -> None:
        """Look for what there is to learn from, without recording anything.

        :raises ValueError: if :meth:`data` would say so
        :raises ImportError: if the controller needs what is not installed; one line
        """
        if self.demonstrations is None:
            validation_episodes(self.n_demonstrations, self.validation_share)
            check_recording(self.controller, area_scene(self.env))
        else:
            self.data()

    def data(self, report: Callable[[int], None] | None = None) -> tuple[JointSteps, JointSteps]:
        """Return the steps to learn from and those to validate on, recorded first if need be.

        :param report: told how many episodes are recorded, from time to time
        :raises DemonstrationError: if the file is damaged, has too few episodes, or is nothing
            that the policy can read
        :raises ValueError: if there is none and the environment is not area search, if there is
            nothing to validate on or to learn from, or if a demonstrated move is impossible
        :raises ImportError: if the controller needs what is not installed; one line
        """
        if self._data is None:
            n_validation = validation_episodes(self.n_demonstrations, self.validation_share)
            # There is no logger before learn().
            logger = getattr(self, "_logger", None)
            folder = None if logger is None else logger.dir
            found = obtain(
                self.demonstrations,
                self.controller,
                area_scene(self.env),
                self.n_demonstrations,
                self.seed or 0,
                None if folder is None else Path(folder) / DEMONSTRATIONS_FILE,
                report or self._report,
            )
            order = self._generator(_SPLIT).permutation(len(found))
            train, validation = order[n_validation:], order[:n_validation]
            data = JointSteps(found, train), JointSteps(found, validation)
            self._check_readable(data[0])
            self._data, self.facts = data, describe(found, self.demonstrations)
            if self.verbose:
                print(self.summary(), flush=True)
        return self._data

    def summary(self) -> str:
        """Say in one line what is learned from, and how its scene differs from the environment's.

        :raises ValueError: see :meth:`data`
        """
        self.data()
        return summary(self.facts, area_scene(self.env))

    def _report(self, count: int) -> None:
        if self.verbose:
            of = f"{self.n_demonstrations} episodes of {self.controller}"
            print(f"recorded {count} of {of}", flush=True)

    def _check_readable(self, steps: JointSteps) -> None:
        """Refuse maps and teams that the policy was not built for; those of GNN read any."""
        found = steps.demonstrations
        self.policy.set_training_mode(False)
        try:
            with th.inference_mode():
                self._cross_entropy(*moved(*steps[0], self.device))
        except (KeyError, IndexError, RuntimeError) as error:
            raise DemonstrationError(
                f"{type(self.policy).__name__} can not read demonstrations of {found.n_agents} "
                f"robots on {found.size[0]} x {found.size[1]} cells: {one_line(error)}"
            ) from error

    def _generator(self, *purpose: int) -> np.random.Generator:
        """Return a generator of its own for each purpose: epochs can be resumed."""
        return np.random.default_rng([self.seed or 0, *purpose])

    # Stable-Baselines3's loop

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        rollout_buffer: RolloutBuffer,
        n_rollout_steps: int,
    ) -> bool:
        """Play ``n_rollout_steps`` joint steps in every team, with the likeliest moves.

        :return: False if training is finished, or a callback asked to stop
        """
        if self.finished:
            return False
        self.data()
        self.policy.set_training_mode(False)
        callback.on_rollout_start()
        for _ in range(n_rollout_steps):
            obs = obs_as_tensor(self._last_obs, self.device)  # type: ignore[arg-type]
            with th.inference_mode():
                actions = self.policy._predict(obs, deterministic=True).cpu().numpy()
            new_obs, rewards, dones, infos = env.step(actions)
            self.num_timesteps += env.num_envs
            callback.update_locals(locals())
            if not callback.on_step():
                return False
            self._update_info_buffer(infos, dones)
            self._last_obs = new_obs  # type: ignore[assignment]
            self._last_episode_starts = dones
        callback.on_rollout_end()
        return True

    def train(self) -> None:
        """Go once through the demonstrations, and validate."""
        train, validation = self.data()
        self.policy.set_training_mode(True)
        seed = int(self._generator(_ORDER, self.epochs).integers(2**62))
        shuffle = th.Generator().manual_seed(seed)
        losses, right = [], []
        for batch in batches(train, self.batch_size, self.device, shuffle):
            rate = self.learning_rate * self.lr_decay ** (self._n_updates // self.lr_decay_every)  # type: ignore[operator]
            update_learning_rate(self.policy.optimizer, rate)
            loss, accuracy = self._cross_entropy(*batch)
            gradients = th.autograd.grad(loss, trainable(self.policy), allow_unused=True)
            try:
                self._optimize(loss, gradients)
            except NotFiniteError as error:
                where = f"update {self._n_updates + 1}"
                raise error.found_in(where, {**batch[0], "actions": batch[1]}) from None
            self._n_updates += 1
            losses.append(loss.detach())
            right.append(accuracy)
        self.epochs += 1
        self.logger.record("train/loss", float(th.stack(losses).mean()))
        self.logger.record("train/accuracy", float(th.stack(right).mean()))
        self.logger.record("train/learning_rate", rate)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/epochs", self.epochs)
        self._keep_best(*self.validate(validation))
        if self.finished or self.num_timesteps >= self._total_timesteps:
            self.policy.load_state_dict(self.best_weights)

    def _keep_best(self, loss: float, accuracy: float) -> None:
        if loss < self.best_loss:
            self.best_loss, self.best_epoch = loss, self.epochs
            weights = self.policy.state_dict()
            self.best_weights = {name: value.detach().clone() for name, value in weights.items()}
        self.logger.record("validation/loss", loss)
        self.logger.record("validation/accuracy", accuracy)
        self.logger.record("validation/best_loss", self.best_loss)
        self.logger.record("validation/best_epoch", self.best_epoch)

    def validate(self, steps: JointSteps) -> tuple[float, float]:
        """Measure the policy on some steps.

        :param steps: of demonstrations
        :return: mean cross-entropy in nats, and share of the moves that are the demonstrated ones
        """
        self.policy.set_training_mode(False)
        total = np.zeros(3)
        for observations, actions in batches(steps, _VALIDATION_BATCH, self.device):
            with th.inference_mode():
                loss, accuracy = self._cross_entropy(observations, actions)
            total += len(actions) * np.array([float(loss), float(accuracy), 1.0])
        return float(total[0] / total[2]), float(total[1] / total[2])

    def _cross_entropy(
        self, observations: Mapping[str, th.Tensor], actions: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        logits = self.policy.get_distribution(observations).distribution.logits  # type: ignore[union-attr]
        chosen = logits.gather(1, actions.unsqueeze(1)).squeeze(1)
        if bool((chosen < LOG_ZERO / 2).any()):
            raise ValueError("a demonstrated move goes into an obstacle or an unknown cell")
        return -chosen.mean(), (logits.argmax(1) == actions).float().mean()

    # Resuming

    def get_state(self) -> dict[str, Any]:
        """Return what the coming epochs depend on, beside weights and counters."""
        return plain_state(
            CloningState(self.epochs, self.best_epoch, self.best_loss, self.best_weights),
            self.facts,
        )

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned.

        :raises CheckpointError: if it is damaged, does not fit the policy, or the demonstrations
            are others; nothing is changed then
        """
        found, facts = read_state(state, self.policy.state_dict())
        if facts:
            self.data()
            check_same_demonstrations(facts, self.facts)
        self.epochs, self.best_epoch = found.epochs, found.best_epoch
        self.best_loss, self.best_weights = found.best_loss, dict(found.best_weights)
