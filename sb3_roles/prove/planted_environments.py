"""Bugs that environments have had, each planted in the area search on small maps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from area_search import AreaSearchEnv, BatchedAreaSearch

HORIZON = 12
_LATE = 5  # A step at which most of these bugs show, well behind the first.


class SmallSearch(AreaSearchEnv):
    """The environment as it should be: three robots on a small map."""

    def __init__(self) -> None:
        super().__init__(
            height=9, width=9, n_targets=8, n_agents=3, horizon=HORIZON, sub_goal="nearest"
        )

    @property
    def clock(self) -> int:
        """Steps since the reset."""
        return int(self._batch.steps[0])


class OutOfBounds(SmallSearch):
    """A position beyond the map."""

    def _observations(self) -> Any:
        observations = super()._observations()
        if self.clock == _LATE:
            observations["robot_1"]["position"] += 20
        return observations


class NotANumber(SmallSearch):
    """A NaN among the path features."""

    def _observations(self) -> Any:
        observations = super()._observations()
        if self.clock == _LATE:
            observations["robot_2"]["sub_goal"][0, 0] = np.nan
        return observations


class OtherDtype(SmallSearch):
    """float64 where float32 is declared, after the reset."""

    def _observations(self) -> Any:
        observations = super()._observations()
        if self.clock:
            position = observations["robot_0"]["position"]
            observations["robot_0"]["position"] = position.astype(np.float64)
        return observations


class OtherShape(SmallSearch):
    """An axis too many, after the reset."""

    def _observations(self) -> Any:
        observations = super()._observations()
        if self.clock:
            observations["robot_0"]["position"] = observations["robot_0"]["position"][None]
        return observations


class Aliased(SmallSearch):
    """Observations are the arrays that the next step overwrites."""

    def _observations(self) -> Any:
        shared, arrays = self.team_observation_keys, self._batch.first_team
        return {
            agent: {key: value if key in shared else value[i] for key, value in arrays.items()}
            for i, agent in enumerate(self.possible_agents)
        }


class Leaking(SmallSearch):
    """What was played before a reset, even one with a seed, is felt after it."""

    def __init__(self) -> None:
        super().__init__()
        self._played = 0

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step; rewards wear off over all episodes together."""
        observations, rewards, *rest = super().step(actions)
        self._played += 1
        tired = {agent: reward / self._played for agent, reward in rewards.items()}
        return observations, tired, *rest


class Nondeterministic(SmallSearch):
    """Random numbers without a seed, from the second step on."""

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step, with noise in the rewards."""
        observations, rewards, *rest = super().step(actions)
        if self.clock > 1:
            rewards = {agent: x + np.random.default_rng().random() for agent, x in rewards.items()}
        return observations, rewards, *rest


class Endless(SmallSearch):
    """The horizon is never reported, and the episode goes on."""

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step on and on."""
        observations, rewards, terminations, _, infos = super().step(actions)
        self.agents = list(self.possible_agents)
        return observations, rewards, terminations, dict.fromkeys(self.agents, False), infos


class LeftBehind(SmallSearch):
    """The last robot stays among the agents when the episode has ended."""

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step, and forget to remove a robot."""
        result = super().step(actions)
        if not self.agents:
            self.agents = self.possible_agents[-1:]
        return result


class NoInfo(SmallSearch):
    """A robot gets no info."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start an episode, and leave an info out."""
        observations, infos = super().reset(seed, options)
        del infos["robot_1"]
        return observations, infos

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step, and leave an info out."""
        result = super().step(actions)
        del result[4]["robot_1"]
        return result


class RewardArray(SmallSearch):
    """Rewards are arrays of one number."""

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step, with rewards of another type."""
        observations, rewards, *rest = super().step(actions)
        return observations, {agent: np.array([x]) for agent, x in rewards.items()}, *rest


class HorizonTerminates(SmallSearch):
    """The horizon is reported as a termination: nothing would have followed."""

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step, with the two kinds of ends mixed up."""
        observations, rewards, terminations, truncations, infos = super().step(actions)
        return observations, rewards, truncations, terminations, infos


class SeedIgnored(SmallSearch):
    """A reset does not pass its seed on."""

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        """Start some episode."""
        return super().reset(None, options)


class ActionIgnored(SmallSearch):
    """The last robot stops, whatever it is told."""

    def step(self, actions: Mapping[str, int]) -> Any:
        """Step, all but one."""
        return super().step({**actions, "robot_2": 0})


class _Turned(BatchedAreaSearch):
    def step(self, actions: np.ndarray) -> None:
        super().step((np.asarray(actions) + 1) % 5)


class BatchDiffers(SmallSearch):
    """The batched form takes each action for the next one."""

    def batched(self, n_teams: int) -> BatchedAreaSearch:
        """Return the form with actions that are off by one."""
        return _Turned(self.scenes, n_teams, self.sub_goal)


class ClockForgotten(SmallSearch):
    """A restored state starts its clock anew."""

    def set_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore all but the clock."""
        super().set_state({**state, "steps": np.zeros_like(state["steps"])})


ENVIRONMENT_BUGS: dict[str, type[SmallSearch]] = {
    "observation out of bounds": OutOfBounds,
    "NaN in an observation": NotANumber,
    "wrong dtype": OtherDtype,
    "wrong shape": OtherShape,
    "aliased buffers": Aliased,
    "state leaks across a reset": Leaking,
    "nondeterministic after step 1": Nondeterministic,
    "never ends": Endless,
    "an agent stays after its end": LeftBehind,
    "missing info": NoInfo,
    "reward is an array": RewardArray,
    "horizon reported as termination": HorizonTerminates,
    "seed ignored": SeedIgnored,
    "action ignored": ActionIgnored,
    "batched form differs": BatchDiffers,
    "restored state forgets the clock": ClockForgotten,
}
