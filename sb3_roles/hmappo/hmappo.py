"""HMAPPO: role policy and primitive policy, learned together by MAPPO (Section V-C)."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_roles.common.checks import check_not_negative, check_unit
from sb3_roles.common.policies import TeamPolicy
from sb3_roles.common.role_wrapper import RoleWrapper, role_wrapper_of
from sb3_roles.common.team_wrapper import TeamWrapper
from sb3_roles.hmappo.policies import RoleActorCriticPolicy
from sb3_roles.mappo.mappo import MAPPO, StreamSettings


class HMAPPO(MAPPO):
    """Two streams of decisions on the same samples: L = L_p + L_r (Eq. 9).

    The role stream is paid the role reward and has the role critic; the primitive stream is paid
    the primitive reward, and its critic is conditioned on the role. Each has its own returns,
    advantages and coefficients: the parameters of MAPPO are those of the primitive stream, and
    ``role_...`` those of the role stream, by default the same.

    :param policy: ``"RolePolicy"``, or a subclass of ``RoleActorCriticPolicy``
    :param env: an environment of ``make_team_vec_env``, best in a
        :class:`~sb3_roles.common.role_wrapper.RoleWrapper`; else it gets one with its defaults
    :param role_gamma: discount of the role stream
    :param role_gae_lambda: lambda of the role stream
    :param role_clip_range: epsilon of the role stream; a number or a schedule
    :param role_ent_coef: coefficient of the role entropy; a number or a schedule
    :param role_vf_coef: coefficient of the role critic's error
    :param role_kl_coef: first coefficient of the role stream's KL penalty
    :param options: parameters of :class:`~sb3_roles.mappo.mappo.MAPPO`
    :raises ValueError: if a parameter is out of range, or the environment has no teams
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"RolePolicy": RoleActorCriticPolicy}
    wrapper_class: ClassVar[type[TeamWrapper]] = RoleWrapper

    def __init__(
        self,
        policy: str | type[TeamPolicy],
        env: GymEnv | str,
        role_gamma: float | None = None,
        role_gae_lambda: float | None = None,
        role_clip_range: float | Schedule | None = None,
        role_ent_coef: float | Schedule | None = None,
        role_vf_coef: float | None = None,
        role_kl_coef: float | None = None,
        _init_setup_model: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(policy, env, _init_setup_model=False, **options)
        self.role_gamma = self.gamma if role_gamma is None else role_gamma
        self.role_gae_lambda = self.gae_lambda if role_gae_lambda is None else role_gae_lambda
        self.role_clip_range = self.clip_range if role_clip_range is None else role_clip_range
        self.role_ent_coef = self.ent_coef if role_ent_coef is None else role_ent_coef
        self.role_vf_coef = self.vf_coef if role_vf_coef is None else role_vf_coef
        self.role_kl_coef = self.kl_coef if role_kl_coef is None else role_kl_coef
        check_unit(role_gamma=self.role_gamma, role_gae_lambda=self.role_gae_lambda)
        check_not_negative(role_vf_coef=self.role_vf_coef, role_kl_coef=self.role_kl_coef)
        for name in ("role_clip_range", "role_ent_coef"):
            if not callable(getattr(self, name)):
                check_not_negative(**{name: getattr(self, name)})
        if _init_setup_model:
            self._setup_model()

    def _setup_model(self) -> None:
        super()._setup_model()
        self.role_clip_schedule = FloatSchedule(self.role_clip_range)
        self.role_ent_schedule = FloatSchedule(self.role_ent_coef)

    def _initial_kl_coefs(self) -> list[float]:
        return [self.role_kl_coef, self.kl_coef]

    def _settings(self) -> list[StreamSettings]:
        progress = self._current_progress_remaining
        role = StreamSettings(
            self.role_gamma,
            self.role_gae_lambda,
            self.role_clip_schedule(progress),
            self.role_ent_schedule(progress),
            self.role_vf_coef,
        )
        return [role, *super()._settings()]

    def stream_rewards(self, env: VecEnv, rewards: np.ndarray) -> np.ndarray:
        """Return role and primitive rewards of the last step, float32 (n, 2)."""
        wrapper = role_wrapper_of(env)
        if wrapper is None:
            raise ValueError(f"no RoleWrapper around {env}: roles are part of its actions")
        return wrapper.stream_rewards

    def to_env(self, actions: np.ndarray) -> np.ndarray:
        """Return the pairs of role and move as they are."""
        return actions
