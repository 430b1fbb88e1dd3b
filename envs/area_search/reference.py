"""The task once more, in plain Python: slow, obvious, and independent of the kernels.

The tests hold the numba kernels to it bit for bit, and the benchmark measures against it. It shares
with them only the definition of a scene, the names of channels and actions, and the key of a seed.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from area_search.random_streams import seed_key
from area_search.reference_routes import TeamMap, route_features
from area_search.scenes import Scene

Cell = tuple[int, int]
MOVES: tuple[Cell, ...] = ((0, 0), (-1, 0), (0, 1), (1, 0), (0, -1))
_WORD = (1 << 64) - 1
_GAMMA = 0x9E3779B97F4A7C15
_DISCOUNT = 0.9
_SCALE = 1 << 32
_VANISHED = 212  # from this distance on, a discounted distance counts as 0


def _mix(z: int) -> int:
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & _WORD
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & _WORD
    return z ^ (z >> 31)


class ReferenceStream:
    """The random numbers of one episode, one after the other."""

    def __init__(self, seed: int, episode: int) -> None:
        first, second = (int(word) for word in seed_key(seed))
        self.first = first
        self.second = _mix(second ^ _mix((episode * _GAMMA + _GAMMA) & _WORD))
        self.counter = 0

    def word(self) -> int:
        """Return the next 64 bits."""
        word = _mix(_mix((self.first + self.counter * _GAMMA) & _WORD) ^ self.second)
        self.counter += 1
        return word

    def unit(self) -> float:
        """Return the next number in [0, 1)."""
        return (self.word() >> 11) / (1 << 53)

    def normals(self) -> tuple[float, float]:
        """Return two standard normal numbers (polar method)."""
        while True:
            u, v = 2.0 * self.unit() - 1.0, 2.0 * self.unit() - 1.0
            s = u * u + v * v
            if 0.0 < s < 1.0:
                scale = math.sqrt(-2.0 * math.log(s) / s)
                return u * scale, v * scale


class ReferenceAreaSearch:
    """One team, one episode, with sets of cells.

    :param scene: the task
    :param seed: seed of the stream
    :param episode: number of the episode in the stream
    :param sub_goal: ``"none"``, ``"nearest"``, ``"assigned"``, ``"routes"`` or ``"role_routes"``
    :param known_map: observe the team's map, too
    :param time: observe the share of the horizon that is left, too
    """

    def __init__(
        self,
        scene: Scene,
        seed: int,
        episode: int = 0,
        sub_goal: str = "none",
        known_map: bool = False,
        time: bool = False,
    ) -> None:
        self.scene, self.sub_goal = scene, sub_goal
        self.known_map, self.time = known_map, time
        stream = ReferenceStream(seed, episode)
        self.all_cells = [(r, c) for r in range(scene.height) for c in range(scene.width)]
        seed_cell = (int(stream.unit() * scene.height), int(stream.unit() * scene.width))
        self.free = self._carve(stream, seed_cell)
        self.targets = self._place_targets(stream)
        self.robots = [self._spawn(stream, seed_cell) for _ in range(scene.n_agents)]
        self.roles = [0] * scene.n_agents

        self.open = self.targets - set(self.robots)
        self.explored: set[Cell] = set()
        for robot in self.robots:
            self.explored |= self.disc(robot)
        self.n_steps = 0
        self.seen = 0
        self.covered = 0
        self.idle = [0] * scene.n_agents
        self.t90_paper = self.t90_true = -1
        self.new_cells = [0] * scene.n_agents
        self.new_targets = [0] * scene.n_agents

    def _inside(self, cell: Cell) -> bool:
        return 0 <= cell[0] < self.scene.height and 0 <= cell[1] < self.scene.width

    def _carve(self, stream: ReferenceStream, start: Cell) -> set[Cell]:
        free, here = {start}, start
        directions: list[Cell] = []
        while len(free) < self.scene.n_free:
            if not directions:
                word = stream.word()
                directions = [MOVES[1 + (word >> 2 * k & 3)] for k in range(32)]
            step = directions.pop(0)
            there = (here[0] + step[0], here[1] + step[1])
            if self._inside(there):
                here = there
                free.add(here)
        return free

    def _place_targets(self, stream: ReferenceStream) -> set[Cell]:
        cells = sorted(self.free)
        for i in range(self.scene.n_targets):
            j = i + int(stream.unit() * (len(cells) - i))
            cells[i], cells[j] = cells[j], cells[i]
        return set(cells[: self.scene.n_targets])

    def _spawn(self, stream: ReferenceStream, seed_cell: Cell) -> Cell:
        sigma = self.scene.spawn_sigma
        for _ in range(1000):
            a, b = stream.normals()
            row = min(max(int(seed_cell[0] + sigma * a), 0), self.scene.height - 1)
            column = min(max(int(seed_cell[1] + sigma * b), 0), self.scene.width - 1)
            if (row, column) in self.free:
                return row, column
            sigma += self.scene.spawn_sigma_growth
        return seed_cell

    def disc(self, center: Cell) -> set[Cell]:
        """Return the cells of the map that a robot at ``center`` senses."""
        reach = int(self.scene.sensor_radius)
        near = range(-reach, reach + 1)
        cells = {
            (center[0] + dr, center[1] + dc)
            for dr in near
            for dc in near
            if dr**2 + dc**2 <= self.scene.sensor_radius**2
        }
        return {cell for cell in cells if self._inside(cell)}

    def frontier(self) -> set[Cell]:
        """Return the explored free cells with an unexplored cell in their 3 x 3 neighborhood."""
        return {
            (r, c)
            for r, c in self.explored & self.free
            if any(
                self._inside((r + dr, c + dc)) and (r + dr, c + dc) not in self.explored
                for dr in (-1, 0, 1)
                for dc in (-1, 0, 1)
            )
        }

    def step(self, actions: Sequence[int]) -> None:
        """Move all robots once, in index order."""
        for i, action in enumerate(actions):
            row, column = self.robots[i]
            there = (row + MOVES[action][0], column + MOVES[action][1])
            if there in self.free:
                self.robots[i] = there
            new = self.disc(self.robots[i]) - self.explored
            self.explored |= new
            self.new_cells[i] = len(new)
            self.new_targets[i] = int(self.robots[i] in self.open)
            self.open.discard(self.robots[i])
            self.idle[i] = 0 if self.new_targets[i] else self.idle[i] + 1
            self.seen += self.new_cells[i]
            self.covered += self.new_targets[i]
        metrics = self.metrics()
        if self.t90_paper < 0 and metrics["explo_paper"] > 0.9:
            self.t90_paper = self.n_steps
        if self.t90_true < 0 and metrics["explo_true"] >= 0.9:
            self.t90_true = self.n_steps
        self.n_steps += 1

    def metrics(self) -> dict[str, float]:
        """Return explo_paper, explo_true and cover so far."""
        return {
            "explo_paper": self.seen / self.scene.n_free,
            "explo_true": len(self.explored & self.free) / self.scene.n_free,
            "cover": self.covered / self.scene.n_targets,
        }

    @property
    def terminated(self) -> bool:
        """Whether a robot has found nothing for too long."""
        patience = self.scene.early_stop_patience
        return patience is not None and max(self.idle) >= patience

    @property
    def truncated(self) -> bool:
        """Whether the horizon is reached."""
        return self.n_steps >= self.scene.horizon

    def reward_components(self) -> np.ndarray:
        """Return R_e and R_c of each robot's last step, float32 (n_agents, 2)."""
        rows = []
        for i in range(self.scene.n_agents):
            team = [i]
            if self.scene.reward_sharing == "same_role":
                team = [j for j, role in enumerate(self.roles) if role == self.roles[i]]
            counts = []
            for new in (self.new_cells, self.new_targets):
                mean, s = sum(new) / len(new), self.scene.team_share
                counts.append((1 - s) * sum(new[j] for j in team) + s * mean)
            rows.append([counts[0] / self.scene.explore_normalizer, counts[1]])
        return np.array(rows, np.float32)

    def rewards(self) -> np.ndarray:
        """Return the scalar reward of each robot's last step, float32 (n_agents,)."""
        components = self.reward_components().astype(np.float64)
        weighted = self.scene.alpha * components[:, 0] + self.scene.beta * components[:, 1]
        return weighted.astype(np.float32)

    def _map(self, cells: set[Cell]) -> list[list[int]]:
        return [
            [int((r, c) in cells) for c in range(self.scene.width)]
            for r in range(self.scene.height)
        ]

    def observe(self) -> list[dict[str, np.ndarray]]:
        """Return the observation of each robot."""
        frontier, known = self.frontier(), self.open & self.explored
        obstacles = set(self.all_cells) - self.free
        joint = np.array([self._map(frontier), self._map(known)], np.uint8)
        layers = (obstacles, frontier, self.open, set(self.robots), self.explored)
        state = np.array([self._map(layer) for layer in layers], np.uint8)
        features = self._sub_goals(frontier, known) if self.sub_goal != "none" else None
        observations = []
        for i, robot in enumerate(self.robots):
            observation = {
                "local": self._window(robot, obstacles & self.explored, frontier, known),
                "joint": joint,
                "position": np.array(robot, np.float32),
                "state": state,
            }
            if features is not None:
                observation["sub_goal"] = features[i]
            if self.known_map:
                seen = (self.explored & self.free, self.explored - self.free)
                observation["known"] = np.array([self._map(cells) for cells in seen], np.uint8)
            if self.time:
                left = (self.scene.horizon - self.n_steps) / self.scene.horizon
                observation["time"] = np.array([left], np.float32)
            observations.append(observation)
        return observations

    def _window(
        self, robot: Cell, obstacles: set[Cell], frontier: set[Cell], known: set[Cell]
    ) -> np.ndarray:
        reach = self.scene.view_radius
        heard = {
            other
            for other in self.robots
            if math.dist(robot, other) < self.scene.communication_radius or other == robot
        }
        rows = range(robot[0] - reach, robot[0] + reach + 1)
        columns = range(robot[1] - reach, robot[1] + reach + 1)
        cells = [(row, column) for row in rows for column in columns]
        channels = [
            [cell in obstacles or not self._inside(cell) for cell in cells],
            *([cell in layer for cell in cells] for layer in (frontier, known, heard)),
        ]
        return np.array(channels, np.uint8).reshape(4, len(rows), len(columns))

    def _distances(self, start: Cell, ground: set[Cell]) -> dict[Cell, int]:
        distances, queue = {start: 0}, deque([start])
        while queue:
            cell = queue.popleft()
            for move in MOVES[1:]:
                there = (cell[0] + move[0], cell[1] + move[1])
                if there in ground and there not in distances:
                    distances[there] = distances[cell] + 1
                    queue.append(there)
        return distances

    def _first_moves(self, start: Cell, goal: Cell, ground: set[Cell]) -> list[int]:
        """Flag the actions that start a shortest path: those after which the goal is nearer."""
        if start == goal:
            return [1, 0, 0, 0, 0]
        to_goal = self._distances(goal, ground)
        flags = [0]
        for move in MOVES[1:]:
            there = (start[0] + move[0], start[1] + move[1])
            flags.append(int(there in to_goal and to_goal[there] == to_goal[start] - 1))
        return flags

    def _sub_goals(self, frontier: set[Cell], known: set[Cell]) -> np.ndarray:
        ground = self.explored & self.free
        distances = [self._distances(robot, ground) for robot in self.robots]
        width = 6 if self.sub_goal == "nearest" else 11
        rows = {"routes": 3, "role_routes": 5}.get(self.sub_goal, 2)
        out = np.zeros((len(self.robots), rows, width), np.float32)
        if self.sub_goal in ("routes", "role_routes"):
            unexplored = set(self.all_cells) - self.explored
            density = self.scene.n_targets / self.scene.n_free
            left = max(1, self.scene.horizon - self.n_steps)
            team_map = TeamMap(
                ground, known, unexplored, self.disc, density, len(self.robots), left
            )
            in_roles = self.sub_goal == "role_routes"
            out[:, -1], out[:, : 2 * in_roles] = route_features(team_map, self.robots, in_roles)
        # The rows of the goal sets, behind those of the roles.
        of_goals = out[:, 2:4] if self.sub_goal == "role_routes" else out
        for k, goals in enumerate((frontier, known)):
            if self.sub_goal == "nearest":
                chosen = [_nearest(goals, near) for near in distances]
            else:
                chosen = self._match(goals, distances, spread=1 - k)
            for i, robot in enumerate(self.robots):
                for goal in chosen[i]:
                    flags = self._first_moves(robot, goal, ground)
                    of_goals[i, k, :5] = np.maximum(of_goals[i, k, :5], flags)
                    of_goals[i, k, 5] = _worth(distances[i][goal]) / _SCALE
                if self.sub_goal != "nearest":
                    of_goals[i, k, 6:] = self._territory(i, goals, distances, ground)
        return out

    def _match(
        self, goals: set[Cell], distances: list[dict[Cell, int]], spread: int
    ) -> list[set[Cell]]:
        chosen: list[set[Cell]] = [set() for _ in self.robots]
        left = set(goals)
        while True:
            pairs = [
                (near[goal], i, goal)
                for i, near in enumerate(distances)
                if not chosen[i]
                for goal in left
                if goal in near
            ]
            if not pairs:
                return chosen
            _, i, goal = min(pairs)
            chosen[i] = {goal}
            left = {g for g in left if max(abs(g[0] - goal[0]), abs(g[1] - goal[1])) > spread}

    def _territory(
        self, i: int, goals: set[Cell], distances: list[dict[Cell, int]], ground: set[Cell]
    ) -> list[float]:
        sums = [0] * 5
        for goal in goals & set(distances[i]):
            mine = distances[i][goal]
            others = [near[goal] for j, near in enumerate(distances) if j != i and goal in near]
            if all(mine < other for other in others):
                flags = self._first_moves(self.robots[i], goal, ground)
                sums = [a + _worth(mine) * b for a, b in zip(sums, flags, strict=True)]
        return [total / _SCALE for total in sums]


def _nearest(goals: set[Cell], near: dict[Cell, int]) -> set[Cell]:
    """Return all goals at the smallest distance."""
    within = {goal: near[goal] for goal in goals if goal in near}
    return {goal for goal, d in within.items() if d == min(within.values())}


def _worth(distance: int) -> int:
    """Discount a distance, in fixed point."""
    if distance >= _VANISHED:
        return 0
    return round(float(np.float64(_DISCOUNT) ** distance) * _SCALE)
