"""Goals shared out among the robots of a team one to one, nearest pair first, in numba.

The matching serves the features of ``sub_goal="assigned"`` (``area_search.assignment``), which have
searched the whole map when they ask for it, and controllers that search no farther than it asks.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import KNOWN_TARGET
from area_search.paths import expand
from area_search.random_streams import mix

# Columns of a search's `ends`, see `assign`.
HEAD, TAIL, LISTED, CURSOR = range(4)
N_ENDS = 4

NOBODY = -1

_SIGN_BIT = np.uint64(1)


@njit(cache=True, inline="always")
def share_searches(position: np.ndarray, source: np.ndarray) -> None:
    """Find out which robots of a team share a search: those in one cell; teams start crowded.

    :param position: integer (n_agents, 2)
    :param source: int64 (n_agents,), overwritten with the lowest index of a robot in the same cell
    """
    for i in range(source.shape[0]):
        source[i] = i
        for j in range(i):
            if position[j, 0] == position[i, 0] and position[j, 1] == position[i, 1]:
                source[i] = j
                break


@njit(cache=True)
def count_goals(cells: np.ndarray, bits: int) -> int:
    """Count the cells of a flat map with any of some bits."""
    n = 0
    for cell in range(cells.shape[0]):
        n += (cells[cell] & bits) > 0
    return n


@njit(cache=True, inline="always")
def cell_order(cell: int, salt: int) -> np.int64:
    """Rank cells: by their place in the map with salt 0, else in a random order of that salt."""
    return np.int64(cell) if salt == 0 else np.int64(mix(np.uint64(cell + salt)) >> _SIGN_BIT)


@njit(cache=True, inline="always")
def _rank(cells: np.ndarray, lead: int, cell: int, distance: int) -> int:
    return distance - lead * ((cells[cell] & KNOWN_TARGET) > 0)


@njit(cache=True, inline="always")
def _insert(
    cells: np.ndarray,
    distance: np.ndarray,
    lead: int,
    salt: int,
    cell: int,
    listed: np.ndarray,
    n: int,
) -> None:
    """Insert a cell into the goals of one search, sorted by rank, then in the salted order.

    :param distance: of that search
    :param listed: int32 (n,), the goals; ``n`` of them so far
    """
    rank = _rank(cells, lead, cell, distance[cell])
    # Cells come by distance: few have to make room. Numba is ten times faster with two plain loops
    # than with one that breaks.
    j = n
    while j > 0 and _rank(cells, lead, listed[j - 1], distance[listed[j - 1]]) > rank:
        listed[j] = listed[j - 1]
        j -= 1
    while (
        j > 0
        and _rank(cells, lead, listed[j - 1], distance[listed[j - 1]]) == rank
        and cell_order(listed[j - 1], salt) > cell_order(cell, salt)
    ):
        listed[j] = listed[j - 1]
        j -= 1
    listed[j] = cell


@njit(cache=True)
def list_goals(
    cells: np.ndarray,
    bits: int,
    queue: np.ndarray,
    visited: int,
    distance: np.ndarray,
    listed: np.ndarray,
) -> int:
    """List the goals of a search that is over, by distance, then in map order.

    :param visited: number of cells in ``queue``
    :param listed: int32 (n,), overwritten
    :return: how many goals there are
    """
    n = 0
    for k in range(visited):
        if cells[queue[k]] & bits:
            _insert(cells, distance, 0, 0, queue[k], listed, n)
            n += 1
    return n


@njit(cache=True, inline="always")
def next_goal(
    cells: np.ndarray,
    stride: int,
    bits: int,
    n_goals: int,
    lead: int,
    salt: int,
    s: int,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
    ends: np.ndarray,
    lists: np.ndarray,
    blocked: np.ndarray,
) -> int:
    """Find a source's first goal that is not blocked, searching on only as far as that takes.

    The other arguments are those of :func:`assign`.

    :param s: index of the source
    :return: the cell, or -1
    """
    while True:
        searched = ends[s, HEAD] == ends[s, TAIL] or ends[s, LISTED] == n_goals
        # What is still to be found lies no nearer than the head of the queue.
        safe = 0 if searched else distance[s, queue[s, ends[s, HEAD]]] - lead
        while ends[s, CURSOR] < ends[s, LISTED]:
            cell = lists[s, ends[s, CURSOR]]
            if not searched and _rank(cells, lead, cell, distance[s, cell]) >= safe:
                break
            if not blocked[cell]:
                return int(cell)
            ends[s, CURSOR] += 1
        if searched:
            return NOBODY
        cell = queue[s, ends[s, HEAD]]
        ends[s, HEAD] += 1
        ends[s, TAIL] = expand(cells, stride, cell, distance[s], moves[s], queue[s], ends[s, TAIL])
        if cells[cell] & bits:
            _insert(cells, distance[s], lead, salt, cell, lists[s], ends[s, LISTED])
            ends[s, LISTED] += 1


@njit(cache=True)
def assign(
    cells: np.ndarray,
    stride: int,
    bits: int,
    n_goals: int,
    alone: int,
    lead: int,
    salt: int,
    source: np.ndarray,
    distance: np.ndarray,
    moves: np.ndarray,
    queue: np.ndarray,
    ends: np.ndarray,
    lists: np.ndarray,
    blocked: np.ndarray,
    chosen: np.ndarray,
) -> None:
    """Match robots and goals one to one, nearest pair first.

    Ties go to the robot with the lower index, then to the cell that comes first in the salted
    order. A robot whose search is under way goes on with it as far as the matching asks for more.

    :param cells: uint8 (n,), the padded map, flat; ``stride`` cells per row
    :param bits: what makes a cell a goal, for searches that go on
    :param n_goals: cells with any of these bits; a search ends behind the last
    :param alone: a chosen goal with any of these bits blocks only itself for team mates, any other
        its 3 x 3 neighborhood
    :param lead: known targets count as that much nearer than they are
    :param salt: order of the cells, see :func:`cell_order`
    :param source: int64 (n_agents,), whose search and list of goals a robot shares
    :param distance: with ``moves`` and ``queue`` the searches, (n_agents, n), see
        :func:`~area_search.paths.search`
    :param ends: int64 (n_agents, 4), per source: ``HEAD`` and ``TAIL`` of the queue, equal at the
        end of a search; number of goals ``LISTED``; ``CURSOR``, the first that may not be blocked
    :param lists: int32 (n_agents, n), the goals found so far, sorted
    :param blocked: uint8 (n,), all 0 before and after
    :param chosen: int64 (n_agents,), overwritten with cells, or -1
    """
    n_agents = chosen.shape[0]
    chosen[:] = NOBODY
    left = n_goals
    while left > 0:
        best, best_goal, best_rank = NOBODY, NOBODY, 0
        for i in range(n_agents):
            if chosen[i] != NOBODY:
                continue
            s = source[i]
            # Robots in one cell share the cursor, too: what is blocked is so for all of them.
            goal = next_goal(
                cells,
                stride,
                bits,
                n_goals,
                lead,
                salt,
                s,
                distance,
                moves,
                queue,
                ends,
                lists,
                blocked,
            )
            if goal != NOBODY:
                rank = _rank(cells, lead, goal, distance[s, goal])
                if best == NOBODY or rank < best_rank:
                    best, best_goal, best_rank = i, goal, rank
        if best == NOBODY:
            break
        chosen[best] = best_goal
        left -= _block(cells, stride, bits, alone, best_goal, blocked, 1)
    for i in range(n_agents):
        if chosen[i] != NOBODY:
            _block(cells, stride, bits, alone, chosen[i], blocked, 0)


@njit(cache=True, inline="always")
def _block(
    cells: np.ndarray,
    stride: int,
    bits: int,
    alone: int,
    goal: int,
    blocked: np.ndarray,
    value: int,
) -> int:
    """Block (1) or free (0) a goal and what it blocks; return how many goals that changes."""
    n = 0
    spread = 0 if cells[goal] & alone else 1
    for dy in range(-spread, spread + 1):
        for dx in range(-spread, spread + 1):
            cell = goal + dy * stride + dx
            n += blocked[cell] != value and (cells[cell] & bits) > 0
            blocked[cell] = value
    return n
