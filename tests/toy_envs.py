"""Small multi-agent environments for the tests: a foreign one, and one with all declarations."""

from typing import ClassVar

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class PlainEnv(ParallelEnv):
    """Someone else's environment: Box observations, no declarations, RNG from the constructor."""

    render_mode = None

    def __init__(self, horizon=5):
        self.possible_agents = ["a", "b"]
        self.agents = []
        self.horizon = horizon
        self.rng = np.random.default_rng()

    def observation_space(self, agent):
        return spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def action_space(self, agent):
        return spaces.Discrete(2)

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.agents, self.clock, self.options = list(self.possible_agents), 0, options
        return self.observe(), {a: {"late": 0} for a in self.agents}

    def observe(self):
        return {a: self.rng.normal(size=3).astype(np.float32) for a in self.possible_agents}

    def step(self, actions):
        self.clock += 1
        over = self.clock >= self.horizon
        agents, self.agents = self.agents, [] if over else self.agents
        rewards = {a: float(actions[a]) for a in agents}
        infos = {a: {"late": self.clock} for a in agents}
        flags = dict.fromkeys(agents, False), dict.fromkeys(agents, over)
        return self.observe(), rewards, *flags, infos


class HashedEnv(PlainEnv):
    """Rewards the hash of a text, which is another one in each process."""

    def step(self, actions):
        observations, rewards, *rest = super().step(actions)
        return observations, {agent: hash(agent) % 2**20 / 2**20 for agent in rewards}, *rest


class WitnessEnv(PlainEnv):
    """Notes the first number that each of its episodes shows, and who was closed."""

    seen: ClassVar[list[float]] = []
    closed: ClassVar[list["WitnessEnv"]] = []

    def close(self):
        self.closed.append(self)

    def reset(self, seed=None, options=None):
        observations, infos = super().reset(seed, options)
        self.seen.append(float(observations["a"][0]))
        return observations, infos


class CountingEnv(PlainEnv):
    """Observes numbers by discrete spaces, as many environments do."""

    parts: ClassVar = {
        "count": spaces.Discrete(6),
        "pair": spaces.MultiDiscrete([6, 2]),
        "bits": spaces.MultiBinary(3),
        "noise": spaces.Box(-9, 9, (3,), np.float32),
    }

    def observation_space(self, agent):
        return spaces.Dict(self.parts)

    def observe(self):
        clock = self.clock
        seen = {
            "count": np.int64(clock),
            "pair": np.array([clock, clock % 2], np.int64),
            "bits": np.array([clock & 1, clock & 2, clock & 4], np.int8).clip(max=1),
            "noise": np.zeros(3, np.float32),
        }
        return {agent: {key: seen[key] for key in self.parts} for agent in self.possible_agents}


class BareCountingEnv(CountingEnv):
    """Observes one number, without a Dict around it."""

    def observation_space(self, agent):
        return self.parts["count"]

    def observe(self):
        return dict.fromkeys(self.possible_agents, np.int64(self.clock))


class BatchedToy:
    """Robots on a line: maps in channels-last memory, team keys, components, metrics."""

    n_agents = 3
    horizon = 4
    render_mode = "rgb_array"
    possible_agents = ("robot_0", "robot_1", "robot_2")
    observation_space = spaces.Dict(
        {
            "local": spaces.Box(0, 1, (2, 3, 4), np.uint8),
            "joint": spaces.Box(0, 1, (3, 4, 5), np.uint8),
            "vector": spaces.Box(-np.inf, np.inf, (2,), np.float32),
        }
    )
    action_space = spaces.Discrete(3)
    team_observation_keys = ("joint",)
    reward_component_names = ("move", "team")
    metric_names = ("distance", "clock")

    def __init__(self, n_teams):
        self.n_teams, shape = n_teams, (n_teams, self.n_agents)
        self.position, self.clock = np.zeros(shape, int), np.zeros(n_teams, int)
        self.local = np.zeros((*shape, 3, 4, 2), np.uint8)
        self.joint = np.zeros((n_teams, 4, 5, 3), np.uint8)
        self.vector = np.zeros((*shape, 2), np.float32)
        self.rewards = np.zeros(shape, np.float32)
        self.reward_components = np.zeros((*shape, 2), np.float32)
        self.terminated, self.truncated = np.zeros(n_teams, bool), np.zeros(n_teams, bool)
        self.metrics = {name: np.zeros(n_teams) for name in self.metric_names}
        self.closed = 0

    @property
    def observations(self):
        # Made on demand: pickling, which SuperSuit does to instances, takes views apart.
        return {
            "local": self.local.transpose(0, 1, 4, 2, 3),
            "joint": self.joint.transpose(0, 3, 1, 2),
            "vector": self.vector,
        }

    def reset(self, seed):
        self.rngs = [np.random.default_rng(s) for s in seed]
        self.reset_teams(np.ones(self.n_teams, bool))

    def reset_teams(self, done):
        for team in np.flatnonzero(done):
            self.position[team] = self.rngs[team].integers(0, 50, self.n_agents)
        self.clock[done] = 0
        self.observe()

    def observe(self):
        total = self.position.sum(axis=1)
        bits = np.arange(24).reshape(3, 4, 2) % 11
        self.local[:] = self.position[..., None, None, None] >> bits & 1
        self.joint[:] = total[:, None, None, None] >> np.arange(60).reshape(4, 5, 3) % 9 & 1
        self.vector[:] = np.stack([self.position, self.clock[:, None] + 0 * self.position], axis=-1)

    def step(self, actions):
        self.position += actions
        self.clock += 1
        total = self.position.sum(axis=1)
        self.reward_components[..., 0] = actions
        self.reward_components[..., 1] = (total % 3)[:, None]
        self.rewards[:] = self.reward_components @ np.array([1, 0.5], np.float32)
        self.terminated[:] = total % 5 == 0
        self.truncated[:] = self.clock >= self.horizon
        self.metrics["distance"][:], self.metrics["clock"][:] = total, self.clock
        self.observe()

    def episode_metrics(self, team):
        return {"length": float(self.clock[team]), "total": float(self.position[team].sum())}

    def render(self, team, mode="rgb_array"):
        return np.full((4, 6, 3), self.position[team, 0], np.uint8)

    def close(self):
        self.closed += 1


class ToyEnv(ParallelEnv):
    """The batched toy as a PettingZoo environment of one team; its arrays are reused."""

    render_mode = "rgb_array"
    team_observation_keys = BatchedToy.team_observation_keys
    reward_component_names = BatchedToy.reward_component_names
    metric_names = BatchedToy.metric_names

    def __init__(self):
        self.possible_agents = list(BatchedToy.possible_agents)
        self.metadata = {"name": "toy", "render_fps": 7}
        self.toy = BatchedToy(1)
        self.level = 0

    def batched(self, n_teams):
        return BatchedToy(n_teams)

    def observation_space(self, agent):
        return BatchedToy.observation_space

    def action_space(self, agent):
        return BatchedToy.action_space

    def observe(self):
        toy = self.toy.observations
        return {
            agent: {
                "local": toy["local"][0, i],
                "joint": toy["joint"][0],
                "vector": toy["vector"][0, i],
            }
            for i, agent in enumerate(self.possible_agents)
        }

    def reset(self, seed=None, options=None):
        self.agents = list(self.possible_agents)
        if seed is None:
            self.toy.reset_teams(np.ones(1, bool))
        else:
            self.toy.reset([seed])
        # What SuperSuit would let win over the values of the terminal step.
        wrong = {"metrics": {"distance": 0.0}, "episode_metrics": {}, "reward_components": {}}
        return self.observe(), {agent: dict(wrong) for agent in self.agents}

    def step(self, actions):
        self.toy.step(np.array([[actions[agent] for agent in self.possible_agents]]))
        infos = {}
        over = bool(self.toy.terminated[0] or self.toy.truncated[0])
        shared = self.toy.episode_metrics(0)
        for i, agent in enumerate(self.possible_agents):
            components = self.toy.reward_components[0, i]
            infos[agent] = {
                "reward_components": dict(
                    zip(self.reward_component_names, components, strict=True)
                ),
                "metrics": {name: value[0] for name, value in self.toy.metrics.items()},
            }
            if over:
                infos[agent]["episode_metrics"] = shared
        self.agents = [] if over else self.agents
        rewards = dict(zip(self.possible_agents, self.toy.rewards[0], strict=True))
        terminated = dict.fromkeys(self.possible_agents, bool(self.toy.terminated[0]))
        truncated = dict.fromkeys(self.possible_agents, bool(self.toy.truncated[0]))
        return self.observe(), rewards, terminated, truncated, infos

    def scaled(self, factor):
        self.level += 1
        return factor * self.level

    def render(self):
        return self.toy.render(0)
