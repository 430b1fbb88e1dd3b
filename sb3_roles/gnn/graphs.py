"""The spatial graph of a team: known free cells, and the robots that stand among them.

The graph of Tolstaya et al. (2021): a node for each known free cell and for each robot; neighbors
on the grid are joined both ways, and a robot is joined both ways to the cells that its five actions
lead to. The feature of an edge is its length: 0 for staying, 1 for a move. An action is an edge
from a cell to a robot; a move that is blocked, or whose cell is not known yet, has none.

Graphs of a batch are one graph of many parts. The nodes of a team are contiguous, its cells row by
row and then its robots, and the edges are sorted by receiver (compressed rows): only what is known
is computed, some 200 of 625 cells of the paper's map, where a padded map would compute all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch as th
from numba import njit

from area_search.cells import MOVE_COLUMNS, MOVE_ROWS, N_ACTIONS

NODE_FEATURES = ("robot", "cell", "target", "frontier")
N_FEATURES = len(NODE_FEATURES)


class TeamGraphs(NamedTuple):
    """The graphs of some teams; V nodes, E edges, n robots in all."""

    features: th.Tensor
    """float32 (V, 4): is a robot, is a cell, holds a known uncovered target, is frontier"""
    starts: th.Tensor
    """int64 (V + 1,): the edges into node v are starts[v] .. starts[v + 1] - 1"""
    senders: th.Tensor
    """int64 (E,): the node that each edge comes from"""
    lengths: th.Tensor
    """int64 (E,): 0 or 1, the distance along each edge in cells"""
    teams: th.Tensor
    """int64 (n_teams + 1,): the nodes of team m are teams[m] .. teams[m + 1] - 1"""
    ends: th.Tensor
    """int64 (n, 6): the node of each robot, and those of the cells that its five actions lead to;
    the robot's own again where there is no such cell"""
    open: th.Tensor
    """bool (n, 5): whether there is such a cell, that is, an edge"""

    def receivers(self) -> th.Tensor:
        """Return the node that each edge goes to, int64 (E,)."""
        nodes = th.arange(len(self.features), device=self.starts.device)
        return nodes.repeat_interleave(self.starts.diff())


def build_graphs(
    free: th.Tensor, target: th.Tensor, frontier: th.Tensor, position: th.Tensor
) -> TeamGraphs:
    """Build the graphs of some teams, on the CPU, for any number of robots and size of the map.

    :param free: uint8 (n_teams, height, width), known free cells
    :param target: the same, known uncovered targets
    :param frontier: the same, frontier cells
    :param position: (n_teams, n_agents, 2), row and column of each robot, on the map
    :return: the graphs, on the device of ``free``
    :raises ValueError: if a robot is not on the map
    """
    device = free.device
    known, goals, edge = (
        np.ascontiguousarray(layer.cpu().numpy()) for layer in (free, target, frontier)
    )
    cells = np.ascontiguousarray(position.cpu().numpy().astype(np.int64))
    inside = (cells >= 0) & (cells < np.array(known.shape[1:]))
    if not inside.all():
        raise ValueError("a robot's position is not on the map: row and column are expected")
    arrays = _build(known, goals, edge, cells)
    return TeamGraphs(*(th.from_numpy(array).to(device) for array in arrays))


@njit(cache=True)
def _build(
    free: np.ndarray, target: np.ndarray, frontier: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, ...]:
    n_teams, height, width = free.shape
    n_agents = position.shape[1]
    most = n_teams * n_agents
    for m in range(n_teams):
        for y in range(height):
            for x in range(width):
                most += free[m, y, x] > 0
    features = np.zeros((most, N_FEATURES), np.float32)
    starts = np.zeros(most + 1, np.int64)
    senders = np.empty(4 * most + 2 * N_ACTIONS * n_teams * n_agents, np.int64)
    lengths = np.empty(len(senders), np.int64)
    teams = np.zeros(n_teams + 1, np.int64)
    ends = np.empty((n_teams, n_agents, 1 + N_ACTIONS), np.int64)
    is_open = np.zeros((n_teams, n_agents, N_ACTIONS), np.bool_)
    # A border of "no node" saves the bounds checks.
    node = np.empty((height + 2, width + 2), np.int64)
    visitors = np.empty((height + 2, width + 2), np.int64)
    n_nodes, n_edges = 0, 0
    for m in range(n_teams):
        node[:] = -1
        visitors[:] = 0
        for i in range(n_agents):
            visitors[position[m, i, 0] + 1, position[m, i, 1] + 1] += 1
        first = n_nodes
        for y in range(height):
            for x in range(width):
                if free[m, y, x] > 0:
                    features[n_nodes, 1] = 1.0
                    features[n_nodes, 2] = target[m, y, x]
                    features[n_nodes, 3] = frontier[m, y, x]
                    node[y + 1, x + 1] = n_nodes
                    n_nodes += 1
        robot_nodes = n_nodes
        n_nodes += n_agents
        k = first
        for y in range(1, height + 1):
            for x in range(1, width + 1):
                if node[y, x] < 0:
                    continue
                starts[k] = n_edges
                near = 0
                for a in range(N_ACTIONS):
                    yy, xx = y + MOVE_ROWS[a], x + MOVE_COLUMNS[a]
                    near += visitors[yy, xx]
                    if a > 0 and node[yy, xx] >= 0:
                        senders[n_edges] = node[yy, xx]
                        lengths[n_edges] = 1
                        n_edges += 1
                if near > 0:
                    for i in range(n_agents):
                        dy = position[m, i, 0] + 1 - y
                        dx = position[m, i, 1] + 1 - x
                        if abs(dy) + abs(dx) <= 1:
                            senders[n_edges] = robot_nodes + i
                            lengths[n_edges] = abs(dy) + abs(dx)
                            n_edges += 1
                k += 1
        for i in range(n_agents):
            own = robot_nodes + i
            starts[own] = n_edges
            features[own, 0] = 1.0
            ends[m, i, 0] = own
            for a in range(N_ACTIONS):
                cell = node[
                    position[m, i, 0] + 1 + MOVE_ROWS[a], position[m, i, 1] + 1 + MOVE_COLUMNS[a]
                ]
                is_open[m, i, a] = cell >= 0
                ends[m, i, 1 + a] = cell if cell >= 0 else own
                if cell >= 0:
                    senders[n_edges] = cell
                    lengths[n_edges] = min(a, 1)
                    n_edges += 1
        teams[m + 1] = n_nodes
    starts[n_nodes] = n_edges
    return (
        features,
        starts,
        senders[:n_edges],
        lengths[:n_edges],
        teams,
        ends.reshape(-1, 1 + N_ACTIONS),
        is_open.reshape(-1, N_ACTIONS),
    )
