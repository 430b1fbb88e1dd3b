"""The known map, the team's graph, and message passing on it."""

import numpy as np
import pytest
import torch as th
from gnn_teams import SCENE, graphs_of, played
from helpers import hand_made, small_search

from area_search import AreaSearchEnv, BatchedAreaSearch
from area_search.reference import ReferenceAreaSearch
from sb3_roles.gnn.graphs import build_graphs
from sb3_roles.gnn.message_passing import MessagePassing

# The known map, which the graph is made of


def test_the_known_map_is_the_reference_s():
    batch = BatchedAreaSearch(SCENE, 2, known_map=True)
    batch.reset([3, 4], 0)
    references = [ReferenceAreaSearch(SCENE, seed, known_map=True) for seed in (3, 4)]
    rng = np.random.default_rng(0)
    for _ in range(10):
        for m, reference in enumerate(references):
            assert np.array_equal(batch.observations["known"][m], reference.observe()[0]["known"])
        moves = rng.integers(0, 5, (2, 3))
        batch.step(moves)
        for reference, row in zip(references, moves.tolist(), strict=True):
            reference.step(row)


def test_the_known_map_changes_no_other_observation():
    plain, more = (BatchedAreaSearch(SCENE, 2, known_map=k) for k in (False, True))
    plain.reset(0)
    more.reset(0)
    assert set(more.observations) - set(plain.observations) == {"known"}
    assert plain.team_observation_keys == ("joint", "state")
    for moves in np.random.default_rng(0).integers(0, 5, (10, 2, 3)):
        for key, value in plain.observations.items():
            assert np.array_equal(value, more.observations[key])
        plain.step(moves)
        more.step(moves)


@pytest.mark.parametrize("backend", ["native", "supersuit"])
def test_the_known_map_reaches_the_rows(backend):
    env = small_search(backend=backend, known_map=True)
    seen = env.reset()
    assert seen["known"].shape == (2, 2, 11, 11)
    assert seen["known"][:, 0].sum() > 0
    single = AreaSearchEnv(scene=SCENE, known_map=True)
    first, _ = single.reset(seed=0)
    copy = single.batched(1)
    copy.reset([0], 0)
    assert np.array_equal(first["robot_0"]["known"], copy.observations["known"][0])


# Graphs


def edges_of(graphs):
    return set(
        zip(
            graphs.senders.tolist(),
            graphs.receivers().tolist(),
            graphs.lengths.tolist(),
            strict=True,
        )
    )


def test_the_graph_of_a_hand_made_map():
    # Cells 0 1 2 / 3 in order; robots are nodes 4 and 5. The target is not frontier here.
    batch = hand_made(["0.T#", "#1#?", "####"])
    batch.show_known_map()
    graphs = graphs_of(batch)
    assert graphs.features.tolist() == [
        [0, 1, 0, 0],
        [0, 1, 0, 0],
        [0, 1, 1, 1],
        [0, 1, 0, 0],
        [1, 0, 0, 0],
        [1, 0, 0, 0],
    ]
    both = [(0, 1, 1), (1, 2, 1), (1, 3, 1), (4, 0, 0), (4, 1, 1), (5, 3, 0), (5, 1, 1)]
    assert edges_of(graphs) == {*both, *((v, u, length) for u, v, length in both)}
    assert graphs.teams.tolist() == [0, 6]
    # Stop, up, right, down, left.
    assert graphs.open.tolist() == [
        [True, False, True, False, False],
        [True, True, False, False, False],
    ]
    assert graphs.ends.tolist() == [[4, 0, 4, 1, 4, 4], [5, 3, 1, 5, 5, 5]]


def test_graphs_are_those_of_a_slow_reference():
    batch = played(4, n_agents=5)
    graphs = graphs_of(batch)
    edges, first = set(), 0
    for m in range(4):
        known = batch.observations["known"][m, 0]
        cells = [tuple(cell) for cell in np.argwhere(known).tolist()]
        node = {cell: first + k for k, cell in enumerate(cells)}
        for (y, x), v in node.items():
            near = [(y - 1, x), (y, x + 1), (y + 1, x), (y, x - 1)]
            edges |= {(node[cell], v, 1) for cell in near if cell in node}
        for i, (y, x) in enumerate(batch.position[m].tolist()):
            robot = first + len(cells) + i
            for length, cell in [(0, (y, x))] + [
                (1, near) for near in ((y - 1, x), (y, x + 1), (y + 1, x), (y, x - 1))
            ]:
                if cell in node:
                    edges |= {(node[cell], robot, length), (robot, node[cell], length)}
        first += len(cells) + 5
    assert edges_of(graphs) == edges
    assert len(graphs.senders) == len(edges)
    assert len(graphs.features) == first


def test_a_robot_off_the_map_is_refused():
    free = th.ones(1, 5, 5, dtype=th.uint8)
    with pytest.raises(ValueError, match="not on the map"):
        build_graphs(free, free, free, th.tensor([[[2.0, 5.0]]]))


# Message passing


def slow_hops(net, graphs):
    """The formula of the docstring, node by node and edge by edge."""
    nodes = list(net.encoder(graphs.features))
    edges = sorted(edges_of(graphs))
    read = [[nodes[v] for v in graphs.ends.flatten().tolist()]]
    for _ in range(net.n_hops):
        new = []
        for v in range(len(nodes)):
            messages = [
                th.relu(
                    net.as_sender(nodes[u])
                    + net.as_receiver(nodes[v])
                    + net.by_length(th.tensor([float(length)]))
                )
                for u, to, length in edges
                if to == v
            ]
            mean = sum(messages) / len(messages) if messages else th.zeros(net.width)
            new.append(th.relu(net.own(nodes[v]) + net.message(mean)))
        nodes = new
        read.append([nodes[v] for v in graphs.ends.flatten().tolist()])
    shape = (-1, *graphs.ends.shape, net.width)
    return th.stack([th.stack(one) for one in read]).view(shape).permute(1, 2, 0, 3)


def gradients(net, embeddings):
    net.zero_grad(set_to_none=True)
    scale = th.linspace(-1, 1, embeddings.numel()).view(embeddings.shape)
    (embeddings * scale).sum().backward()
    return {name: p.grad for name, p in net.named_parameters()}


def test_hops_and_their_gradients_are_those_of_a_slow_reference():
    th.manual_seed(0)
    net = MessagePassing(width=6, n_hops=3)
    graphs = graphs_of(played(2, n_agents=2, height=7, width=7, n_targets=5))
    slow = slow_hops(net, graphs)
    expected = gradients(net, slow)
    for compiled in (False, True):
        fast = net(graphs, compiled)
        th.testing.assert_close(fast, slow)
        for name, gradient in gradients(net, fast).items():
            th.testing.assert_close(gradient, expected[name], atol=1e-4, rtol=1e-4, msg=name)
            assert gradient.abs().max() > 0, name


@pytest.mark.parametrize("n_teams", [1, 33, 70])
def test_the_compiled_loop_is_the_list_of_edges(n_teams):
    # More teams than are computed together.
    th.manual_seed(1)
    net = MessagePassing(width=16, n_hops=5)
    graphs = graphs_of(played(n_teams))
    plain, compiled = net(graphs, False), net(graphs, True)
    th.testing.assert_close(plain, compiled)
    expected = gradients(net, plain)
    for name, gradient in gradients(net, compiled).items():
        scale = expected[name].abs().max()
        assert (gradient - expected[name]).abs().max() < 1e-3 * scale, name


def test_pytorch_geometric_agrees():
    geometric = pytest.importorskip("torch_geometric.nn")

    class Core(geometric.MessagePassing):
        def __init__(self, net):
            super().__init__(aggr="mean")
            self.net = net

        def forward(self, nodes, edges, lengths):
            means = self.propagate(edges, x=nodes, lengths=lengths, size=(len(nodes), len(nodes)))
            return th.relu(self.net.own(nodes) + self.net.message(means))

        def message(self, x_i, x_j, lengths):
            net = self.net
            return th.relu(net.as_sender(x_j) + net.as_receiver(x_i) + net.by_length(lengths))

    net = MessagePassing(width=8, n_hops=4)
    graphs = graphs_of(played(3))
    core, edges = Core(net), th.stack([graphs.senders, graphs.receivers()])
    nodes = net.encoder(graphs.features)
    for _ in range(net.n_hops):
        nodes = core(nodes, edges, graphs.lengths.float().unsqueeze(1))
    th.testing.assert_close(net(graphs)[:, :, -1], nodes[graphs.ends])


def test_nodes_without_edges_and_nan_are_handled():
    nothing = th.zeros(2, 5, 5, dtype=th.uint8)
    graphs = build_graphs(nothing, nothing, nothing, th.zeros(2, 3, 2))
    assert len(graphs.senders) == 0
    net = MessagePassing(width=4, n_hops=2)
    th.testing.assert_close(net(graphs, True), net(graphs, False))
    with th.no_grad():
        net.as_sender.weight.fill_(float("nan"))
    assert net(graphs_of(played(1)), True)[:, :, -1].isnan().all()
