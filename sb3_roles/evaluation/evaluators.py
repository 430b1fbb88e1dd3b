"""What periodic evaluation measures: a function of a model that returns its scores by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from area_search.scenes import Scene, get_scene
from sb3_roles.baselines.area import area_scenes
from sb3_roles.common.callbacks import Evaluate
from sb3_roles.common.env_failures import EnvironmentFailed, close_or_warn
from sb3_roles.common.env_state import env_name
from sb3_roles.common.team_wrapper import find_team_env
from sb3_roles.common.thresholds import first_above
from sb3_roles.evaluation.episodes import run_episodes, stream_seed
from sb3_roles.evaluation.metrics import t90
from sb3_roles.evaluation.policies import PolicyController

MAX_EPISODE_STEPS = 100_000
"""Of an episode of an environment that is not area search; most are of hundreds."""


class SceneEvaluator:
    """Plays episodes of an area-search scene that no training plays, always the same ones.

    :param scene: a scene or the name of one; an early stop is switched off
    :param n_episodes: team episodes
    :param seed: of the stream
    :param deterministic: see :class:`~sb3_roles.evaluation.policies.PolicyController`
    :param role_kwargs: see there; by default those of the model's environment
    :param batch_size: teams simulated together
    :param stream: ``"held_out"``, to measure a policy, or ``"selection"``, to select one
    :raises ValueError: if there is no such stream
    """

    note = ""
    """What a printed score says beside its number."""

    def __init__(
        self,
        scene: Scene | str,
        n_episodes: int = 100,
        seed: int = 0,
        deterministic: bool = True,
        role_kwargs: Mapping[str, Any] | None = None,
        batch_size: int = 256,
        stream: str = "held_out",
    ) -> None:
        self.scene = get_scene(scene).with_options(early_stop_patience=None)
        self.n_episodes = n_episodes
        self.stream_seed = stream_seed(stream, seed)
        self.deterministic = deterministic
        self.role_kwargs = role_kwargs
        self.batch_size = batch_size

    def __call__(self, model: BaseAlgorithm) -> dict[str, float]:
        """Play the episodes.

        :param model: any SB3 model
        :return: ``explo_paper``, ``explo_true``, ``cover`` (mean fractions), ``t90_share``,
            ``n_episodes`` and, where they exist, ``time_e_paper`` and ``t90_true``
        """
        controller = PolicyController(model, self.role_kwargs, self.deterministic)
        records = run_episodes(
            controller,
            self.scene,
            self.n_episodes,
            self.stream_seed,
            batch_size=self.batch_size,
        )
        scores = {name: float(curve[:, -1].mean()) for name, curve in records.curves.items()}
        mean_curve = records.curves["explo_paper"].mean(axis=0, keepdims=True)
        time = int(first_above(mean_curve)[0])
        if time < self.scene.horizon:
            scores["time_e_paper"] = float(time)
        mean, _, share = t90(records.t90_true)
        if mean is not None:
            scores["t90_true"] = mean
        return {**scores, "t90_share": share, "n_episodes": float(self.n_episodes)}

    def close(self) -> None:
        """Nothing is open."""


class MixEvaluator:
    """Plays equal numbers of episodes of several scenes, see :class:`SceneEvaluator`.

    :param scenes: at least two, of different names
    :param n_episodes: team episodes of all scenes together, rounded up to equal shares
    :param seed: of the stream; the scenes share the numbers of its episodes
    :param deterministic: see :class:`SceneEvaluator`
    :param stream: see there
    :raises ValueError: if there is no such stream
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        n_episodes: int = 100,
        seed: int = 0,
        deterministic: bool = True,
        stream: str = "held_out",
    ) -> None:
        share = -(-n_episodes // len(scenes))
        self._parts = {
            scene.name: SceneEvaluator(scene, share, seed, deterministic, stream=stream)
            for scene in scenes
        }
        self.note = f"mean of {', '.join(self._parts)}"

    def __call__(self, model: BaseAlgorithm) -> dict[str, float]:
        """Play the episodes.

        :param model: any SB3 model
        :return: ``explo_paper``, ``explo_true``, ``cover`` and ``t90_share``, means over the
            scenes; ``cover_<scene>`` of each scene; and ``n_episodes``, of all
        """
        scores = {name: evaluate(model) for name, evaluate in self._parts.items()}
        names = ("explo_paper", "explo_true", "cover", "t90_share")
        means = {name: float(np.mean([one[name] for one in scores.values()])) for name in names}
        covers = {f"cover_{scene}": one["cover"] for scene, one in scores.items()}
        total = sum(one["n_episodes"] for one in scores.values())
        return {**means, **covers, "n_episodes": total}

    def close(self) -> None:
        """Nothing is open."""


class VecEnvEvaluator:
    """Plays team episodes of any environment, always the same ones.

    Each team plays an equal share of the episodes, so that short episodes are not preferred.

    A policy with masks is given those of the environment, as in training.

    :param env: a vectorized environment of its own (not the one that is trained on), wrapped as
        that one is; :meth:`close` closes it
    :param n_episodes: team episodes
    :param seed: of the stream; the environment's seed is drawn from both
    :param deterministic: handed to ``predict``
    :param stream: ``"held_out"``, to measure a policy, or ``"selection"``, to select one
    :raises ValueError: if there is no such stream
    """

    note = ""

    def __init__(
        self,
        env: VecEnv,
        n_episodes: int = 20,
        seed: int = 0,
        deterministic: bool = True,
        stream: str = "held_out",
    ) -> None:
        self.env = env
        self.team_env = find_team_env(env)
        self.n_episodes = n_episodes
        self.stream_seed = stream_seed(stream, seed)
        self.deterministic = deterministic

    def __call__(self, model: BaseAlgorithm) -> dict[str, float]:
        """Play the episodes.

        :param model: any SB3 model
        :return: ``return`` (sum over the robots of a team), ``length``, the numbers in the
            environment's ``episode_metrics``, and ``n_episodes``; means
        :raises EnvironmentFailed: if an episode is longer than :data:`MAX_EPISODE_STEPS`
        """
        masked = isinstance(model.policy, MaskableActorCriticPolicy) and is_masking_supported(
            self.env
        )
        teams, agents = self.team_env.n_teams, self.team_env.n_agents
        # VecEnv.reset() takes the seeds once: the next evaluation plays the same episodes.
        self.env.seed(self.stream_seed)
        observations: Any = self.env.reset()
        left = (self.n_episodes + np.arange(teams)) // teams
        returns, length = np.zeros(teams), np.zeros(teams, np.int64)
        episodes: list[dict[str, float]] = []
        state, starts = None, np.ones(teams * agents, np.bool_)
        while left.any():
            masks = {"action_masks": get_action_masks(self.env)} if masked else {}
            actions, state = model.predict(observations, state, starts, self.deterministic, **masks)
            observations, rewards, starts, infos = self.env.step(actions)
            returns += np.asarray(rewards).reshape(teams, agents).sum(axis=1)
            length += 1
            if length.max() > MAX_EPISODE_STEPS:
                raise EnvironmentFailed(
                    f"{env_name(self.env)}: an episode of the evaluation has not ended within "
                    f"{MAX_EPISODE_STEPS:,} steps; sb3_roles.testing.check_episode_ends tells when"
                )
            for team in np.flatnonzero(starts[::agents]):
                if left[team] > 0:
                    left[team] -= 1
                    metrics = infos[team * agents].get("episode_metrics", {})
                    episodes.append(
                        {"return": float(returns[team]), "length": float(length[team]), **metrics}
                    )
                returns[team], length[team] = 0.0, 0
        names = dict.fromkeys(name for episode in episodes for name in episode)
        scores = {
            name: float(np.mean([episode[name] for episode in episodes if name in episode]))
            for name in names
        }
        return {**scores, "n_episodes": float(len(episodes))}

    def close(self) -> None:
        """Release the environment."""
        close_or_warn(self.env)


def make_evaluator(
    model: BaseAlgorithm,
    n_episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    stream: str = "held_out",
) -> Evaluate:
    """Make the evaluation of a model on the task that it is trained on.

    :param model: a model with an area-search environment
    :param n_episodes: team episodes
    :param seed: of the stream
    :param deterministic: take the likeliest actions
    :param stream: ``"held_out"``, to measure a policy, or ``"selection"``, to select one
    :return: see :func:`scenes_evaluator`
    :raises ValueError: if the environment is another one, or there is no such stream
    """
    scenes = area_scenes(model.env)
    if not scenes:
        raise ValueError(
            "the environment is not area search: evaluate on a second one, with "
            "EvaluationCallback(evaluate=VecEnvEvaluator(env, stream='selection'))"
        )
    return scenes_evaluator(scenes, n_episodes, seed, deterministic, stream)


def scenes_evaluator(
    scenes: Sequence[Scene],
    n_episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    stream: str = "held_out",
) -> SceneEvaluator | MixEvaluator:
    """Make the evaluation on one scene, or on each scene of a mix.

    :param scenes: at least one
    :param n_episodes: team episodes
    :param seed: of the stream
    :param deterministic: take the likeliest actions
    :param stream: ``"held_out"``, to measure a policy, or ``"selection"``, to select one
    :raises ValueError: if there is no such stream
    """
    if len(scenes) == 1:
        return SceneEvaluator(scenes[0], n_episodes, seed, deterministic, stream=stream)
    return MixEvaluator(scenes, n_episodes, seed, deterministic, stream)
