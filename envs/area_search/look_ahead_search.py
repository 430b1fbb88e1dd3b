"""The search for the route of one robot, see :mod:`area_search.look_ahead`."""

from __future__ import annotations

import numpy as np
from numba import njit

from area_search.cells import EXPLORED, KNOWN_TARGET, N_ACTIONS, OBSTACLE
from area_search.look_ahead_data import CERTAIN, NONE, ODDS_BITS, Labels, Marks, Routes, Rules

_KNOWN_FREE = EXPLORED
_KNOWN = EXPLORED | OBSTACLE


@njit(cache=True)
def _look(cells: np.ndarray, rules: Rules, cell: int, marks: Marks) -> int:
    """Note what there is to see from a cell; return the sum of its worth."""
    total = 0
    for k in range(rules.disc.shape[0]):
        seen = cell + rules.disc[k]
        if cells[seen] & EXPLORED:
            continue
        if marks.unseen[seen] == 0:
            n_obstacles = 0
            for action in range(1, N_ACTIONS):
                n_obstacles += (cells[seen + rules.offsets[action]] & _KNOWN) == _KNOWN
            marks.unseen[seen] = rules.worths[n_obstacles]
            marks.passable[seen] = rules.passable[n_obstacles]
            marks.noted[1, marks.n_noted[1]] = seen
            marks.n_noted[1] += 1
        total += marks.unseen[seen]
    marks.sight[cell] = total
    marks.noted[0, marks.n_noted[0]] = cell
    marks.n_noted[0] += 1
    return int(total)


@njit(cache=True)
def forget(marks: Marks) -> None:
    """Forget what is noted of a map, but for claims."""
    for k in range(marks.n_noted[0]):
        marks.sight[marks.noted[0, k]] = NONE
    for k in range(marks.n_noted[1]):
        marks.unseen[marks.noted[1, k]] = 0
    marks.n_noted[:] = 0


@njit(cache=True)
def search(
    cells: np.ndarray,
    start: int,
    respect: int,
    target: int,
    see: int,
    rules: Rules,
    marks: Marks,
    labels: Labels,
) -> tuple[int, int]:
    """Search for the best route of one robot, layer by layer; a layer is a step.

    A route that comes to a cell with no more than another had there, at that time or before, is
    given up, and so is one that falls far behind the best. Nothing is gained twice in one cell.
    A route may lead through unseen cells that are seen from the cell before, as long as its way may
    well be open; what it gets from there on counts by the chance of that. Of two ways that are
    worth as much at the same time the first one found goes on, even if the other is likelier to be
    open: to prefer that one does not change what teams cover.

    :param respect: 1 to count only what is gained over the claims, 0 to count all
    :param target: worth of a known target
    :param see: part of their worth that unseen cells count, of ``CERTAIN``
    :return: number of labels, and the index of the best
    """
    cell_of, value_of, parent_of, first_of = labels.cell, labels.value, labels.parent, labels.first
    odds_of, best, slot, claims = labels.odds, labels.best, labels.slot, marks.claims
    sights, unseen, offsets = marks.sight, marks.unseen, rules.offsets
    edges, edge_counts, discounts = rules.edges, rules.edge_counts, rules.discounts
    depth, slack, left = rules.depth, rules.slack, rules.left
    cell_of[0], value_of[0], parent_of[0], first_of[0] = start, 0, NONE, 0
    odds_of[0], best[start], slot[start] = CERTAIN, 0, 0
    if sights[start] < 0:
        _look(cells, rules, start, marks)
    low, high, top, top_value, t = 0, 1, 0, 0, 0
    last = discounts.shape[0] - 1
    while low < high and t < left and (t < depth or top_value == 0):
        t += 1
        discount = discounts[min(t, last)]
        hopeless = top_value - slack * discount
        end = high
        for k in range(low, high):
            before = value_of[k]
            if before < hopeless:
                continue
            for action in range(1, N_ACTIONS):
                cell = cell_of[k] + offsets[action]
                odds = odds_of[k]
                if cells[cell] & _KNOWN != _KNOWN_FREE:
                    if cells[cell] & EXPLORED or unseen[cell] == 0:
                        continue
                    odds = odds * marks.passable[cell] >> ODDS_BITS
                    if odds < rules.least_odds:
                        continue
                got = 0
                if cells[cell] & KNOWN_TARGET:
                    got = target * max(0, discount - respect * claims[cell])
                sight = sights[cell]
                if sight < 0:
                    sight = _look(cells, rules, cell, marks)
                if sight > 0:
                    if before + ((got + sight * discount) * odds >> ODDS_BITS) < best[cell]:
                        continue
                    view = 0
                    for q in range(edge_counts[action]):
                        seen = cell + edges[action, q]
                        gain = discount - respect * claims[seen]
                        if gain > 0:
                            view += unseen[seen] * gain
                    got += view * see >> ODDS_BITS
                value = before + (got * odds >> ODDS_BITS)
                if value < best[cell]:
                    continue
                here = slot[cell]
                # Equally good at the same time: the robot may begin either way.
                if value == best[cell] and here < high:
                    continue
                if value > before:
                    own = k
                    while own >= 0 and cell_of[own] != cell:
                        own = parent_of[own]
                    if own >= 0:
                        # It got what there is when it came by before.
                        value = before
                        if value <= best[cell]:
                            continue
                first = np.uint8(1 << action) if t == 1 else first_of[k]
                if value == best[cell]:
                    first_of[here] |= first
                    continue
                best[cell] = value
                if here < high:
                    here = end
                    end += 1
                    slot[cell] = here
                    cell_of[here] = cell
                value_of[here], parent_of[here], first_of[here] = value, k, first
                odds_of[here] = odds
                if value > top_value:
                    top, top_value = here, value
        low, high = high, end
    for k in range(high):
        best[cell_of[k]] = NONE
        slot[cell_of[k]] = NONE
    return high, top


@njit(cache=True)
def keep(i: int, n_labels: int, top: int, labels: Labels, routes: Routes) -> None:
    """Write down what a search found."""
    parent, value = labels.parent, labels.value
    length, k = 0, top
    while k > 0:
        length += 1
        k = parent[k]
    routes.lengths[i], routes.begin[i] = length, 0
    routes.first[i] = labels.first[top]
    k = top
    while k > 0:
        if value[k] > 0:
            routes.begin[i] = length
        length -= 1
        routes.cells[i, length] = labels.cell[k]
        k = parent[k]
    worth = routes.worth[i]
    worth[:] = 0
    for k in range(1, n_labels):
        for action in range(1, N_ACTIONS):
            if (labels.first[k] >> action) & 1:
                worth[action] = max(worth[action], value[k])
