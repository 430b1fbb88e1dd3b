"""GNN: behavior cloning of demonstrations on the team's graph."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
from torch.utils.data import DataLoader

from sb3_roles.common.checks import check_not_negative, check_positive, check_unit
from sb3_roles.common.distributions import LOG_ZERO
from sb3_roles.common.policies import TeamPolicy
from sb3_roles.common.team_wrapper import find_team_env
from sb3_roles.gnn.demonstrations import Demonstrations, JointSteps, load_demonstrations
from sb3_roles.gnn.policies import GNNPolicy
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

    def data(self) -> tuple[JointSteps, JointSteps]:
        """Return the steps to learn from and those to validate on, recorded first if need be.

        :raises DemonstrationError: if the file is damaged, or has too few episodes
        :raises ValueError: if there is none, and the environment is not area search
        """
        if self._data is None:
            if self.demonstrations is not None:
                found = load_demonstrations(self.demonstrations).first(self.n_demonstrations)
            else:
                found = self._record()
            order = self._generator(_SPLIT).permutation(len(found))
            n_validation = round(self.validation_share * len(found))
            if not 0 < n_validation < len(found):
                raise ValueError(
                    f"validation_share {self.validation_share} of {len(found)} episodes leaves "
                    "none to validate on, or none to learn from"
                )
            train, validation = order[n_validation:], order[:n_validation]
            self._data = JointSteps(found, train), JointSteps(found, validation)
        return self._data

    def _record(self) -> Demonstrations:
        try:
            scene = find_team_env(self.env).get_attr("scene", [0])[0]
        except AttributeError:
            raise ValueError(
                "the environment is not area search: give demonstrations, a file of them"
            ) from None
        from sb3_roles.gnn.recording import record

        folder = self.logger.dir
        path = None if folder is None else Path(folder) / DEMONSTRATIONS_FILE
        if self.verbose:
            print(f"recording {self.n_demonstrations} episodes of {self.controller}", flush=True)
        return record(self.controller, scene, self.n_demonstrations, self.seed or 0, path)

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
        losses, right = [], []
        for batch in self._batches(train, self.batch_size, th.Generator().manual_seed(seed)):
            rate = self.learning_rate * self.lr_decay ** (self._n_updates // self.lr_decay_every)  # type: ignore[operator]
            update_learning_rate(self.policy.optimizer, rate)
            loss, accuracy = self._cross_entropy(*batch)
            self._optimize(loss)
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
        for observations, actions in self._batches(steps, _VALIDATION_BATCH):
            with th.inference_mode():
                loss, accuracy = self._cross_entropy(observations, actions)
            total += len(actions) * np.array([float(loss), float(accuracy), 1.0])
        return float(total[0] / total[2]), float(total[1] / total[2])

    def _batches(
        self, steps: JointSteps, batch_size: int, generator: th.Generator | None = None
    ) -> Iterator[tuple[dict[str, th.Tensor], th.Tensor]]:
        """Go through some steps, shuffled if there is a generator."""
        loader = DataLoader(
            steps,
            batch_size,
            shuffle=generator is not None,
            generator=generator,
            collate_fn=lambda batch: batch,
        )
        for observations, actions in loader:
            moved = {key: value.to(self.device) for key, value in observations.items()}
            yield moved, actions.to(self.device)

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
        return {
            "epochs": self.epochs,
            "best_epoch": self.best_epoch,
            "best_loss": self.best_loss,
            "best_weights": {k: v.cpu().numpy() for k, v in self.best_weights.items()},
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from what :meth:`get_state` returned."""
        self.epochs, self.best_epoch = int(state["epochs"]), int(state["best_epoch"])
        self.best_loss = float(state["best_loss"])
        self.best_weights = {
            name: th.from_numpy(np.array(value)).to(self.device)
            for name, value in state["best_weights"].items()
        }
