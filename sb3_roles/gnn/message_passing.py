"""Message passing on the graphs of teams: one core, applied hop after hop.

A hop of the core (Tolstaya et al. 2021, with a hidden layer in the edge's network):

    m_v  = mean over the edges u -> v of ReLU(A h_u + B h_v + c length + d)
    h_v' = ReLU(C h_v + D m_v + e)

A linear layer behind the ReLU of the messages would be part of D, because the mean is linear.
Weights are the same in all hops, so that their number does not depend on how far robots look.

On a CPU the messages are added up by a compiled loop that stores nothing per edge, some teams at a
time so that they stay in the cache, and the backward pass computes messages again instead of
reading them from memory. Other devices, and other number formats, take PyTorch's operations on
lists of edges: the same formula, 3 to 5 times slower on a CPU. That second form is also
what a library of sparse graphs such as PyTorch Geometric runs, which is therefore not needed.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch as th
from numba import njit
from torch import nn
from torch.nn import functional as F

from sb3_roles.common.torch_layers import mlp
from sb3_roles.gnn.graphs import N_FEATURES, TeamGraphs, build_graphs

N_LENGTHS = 2
# Teams that are computed together: some 1 MB of embeddings and messages.
_CHUNK = 32
_ZERO = np.float32(0.0)


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _mean_messages(
    parts: np.ndarray,
    by_length: np.ndarray,
    starts: np.ndarray,
    senders: np.ndarray,
    lengths: np.ndarray,
    first: int,
    means: np.ndarray,
) -> None:
    """Write the mean message into each of some nodes, whose edges are among themselves.

    :param parts: float32 (v, 3 c): what each node adds as a sender, as a receiver, and not used
    :param by_length: float32 (2, c): what an edge adds
    :param starts: int64 (v + 1,): edges into each node
    :param first: number of the first of the nodes
    :param means: float32 (v, c): overwritten; 0 where no edge ends
    """
    width = means.shape[1]
    for v in range(means.shape[0]):
        mean, receiver = means[v], parts[v, width : 2 * width]
        mean[:] = _ZERO
        for e in range(starts[v], starts[v + 1]):
            sender, length = parts[senders[e] - first, :width], by_length[lengths[e]]
            for k in range(width):
                x = sender[k] + receiver[k] + length[k]
                # Written so that a NaN goes on.
                mean[k] += _ZERO if x <= _ZERO else x
        scale = np.float32(1.0 / max(1, starts[v + 1] - starts[v]))
        for k in range(width):
            mean[k] *= scale


@njit(cache=True, error_model="numpy", fastmath={"contract", "nsz"})
def _mean_messages_backward(
    parts: np.ndarray,
    by_length: np.ndarray,
    starts: np.ndarray,
    senders: np.ndarray,
    lengths: np.ndarray,
    first: int,
    grad_means: np.ndarray,
    grad_parts: np.ndarray,
    grad_by_length: np.ndarray,
) -> None:
    """Add the gradients of :func:`_mean_messages`.

    :param grad_parts: float32 (v, 3 c): the first two thirds are added to
    :param grad_by_length: float32 (2, c): added to
    """
    width = grad_means.shape[1]
    scaled, passed = np.empty(width, np.float32), np.empty(width, np.float32)
    for v in range(grad_means.shape[0]):
        scale = np.float32(1.0 / max(1, starts[v + 1] - starts[v]))
        grad_mean = grad_means[v]
        for k in range(width):
            scaled[k] = grad_mean[k] * scale
        receiver, to_receiver = parts[v, width : 2 * width], grad_parts[v, width : 2 * width]
        for e in range(starts[v], starts[v + 1]):
            u, kind = senders[e] - first, lengths[e]
            sender, length = parts[u, :width], by_length[kind]
            to_sender, to_length = grad_parts[u, :width], grad_by_length[kind]
            # Loops of one target each, and rows instead of indices: so the compiler vectorizes.
            for k in range(width):
                x = sender[k] + receiver[k] + length[k]
                passed[k] = _ZERO if x <= _ZERO else scaled[k]
            for k in range(width):
                to_receiver[k] += passed[k]
            for k in range(width):
                to_sender[k] += passed[k]
            for k in range(width):
                to_length[k] += passed[k]


class _CompiledHops(th.autograd.Function):
    """All hops in float32 on the CPU; :func:`plain_hops` is the same."""

    @staticmethod
    def forward(
        ctx: Any,
        nodes: th.Tensor,
        weight: th.Tensor,
        bias: th.Tensor,
        by_length: th.Tensor,
        message: th.Tensor,
        graphs: TeamGraphs,
        n_hops: int,
    ) -> th.Tensor:
        width = message.shape[0]
        hops = th.empty(n_hops + 1, *nodes.shape)
        hops[0] = nodes
        lengths = by_length.detach().numpy()
        for chunk in _chunks(graphs):
            parts, means = chunk.scratch(3 * width), chunk.scratch(width)
            for k in range(n_hops):
                th.addmm(bias, hops[k, chunk.nodes], weight, out=parts)
                _mean_messages(parts.numpy(), lengths, *chunk.edges, means.numpy())
                after = hops[k + 1, chunk.nodes]
                th.addmm(parts[:, 2 * width :], means, message, out=after).relu_()
        ctx.save_for_backward(hops, weight, bias, by_length, message)
        ctx.graphs = graphs
        return hops[:, graphs.ends.flatten()]

    @staticmethod
    def backward(ctx: Any, grad_ends: th.Tensor) -> tuple[th.Tensor | None, ...]:
        hops, weight, bias, by_length, message = ctx.saved_tensors
        width, ends = message.shape[0], ctx.graphs.ends
        grads = [th.zeros(tensor.shape) for tensor in (weight, bias, by_length, message)]
        grad_weight, grad_bias, grad_by_length, grad_message = grads
        grad_nodes = th.zeros_like(hops[0])
        lengths = by_length.detach().numpy()
        robots_per_team = len(ends) // (len(ctx.graphs.teams) - 1)
        for chunk in _chunks(ctx.graphs):
            rows = slice(chunk.teams.start * robots_per_team, chunk.teams.stop * robots_per_team)
            read = ends[rows].flatten() - chunk.nodes.start
            columns = slice(rows.start * ends.shape[1], rows.stop * ends.shape[1])
            parts, means = chunk.scratch(3 * width), chunk.scratch(width)
            grad_parts, grad_hop_lengths = chunk.scratch(3 * width), th.empty_like(grad_by_length)
            grad = grad_nodes[chunk.nodes]
            for k in reversed(range(len(hops))):
                grad.index_add_(0, read, grad_ends[k, columns])
                if k == 0:
                    break
                before, after = hops[k - 1, chunk.nodes], hops[k, chunk.nodes]
                # As in the forward pass.
                th.addmm(bias, before, weight, out=parts)
                _mean_messages(parts.numpy(), lengths, *chunk.edges, means.numpy())
                own = th.ops.aten.threshold_backward(grad, after, 0.0)
                grad_parts.zero_()
                grad_parts[:, 2 * width :] = own
                _mean_messages_backward(
                    parts.numpy(),
                    lengths,
                    *chunk.edges,
                    (own @ message.t()).numpy(),
                    grad_parts.numpy(),
                    # Of one hop at a time: a float32 that everything is added to loses digits.
                    grad_hop_lengths.zero_().numpy(),
                )
                grad_by_length += grad_hop_lengths
                grad_message.addmm_(means.t(), own)
                grad_weight.addmm_(before.t(), grad_parts)
                grad_bias += grad_parts.sum(0)
                th.mm(grad_parts, weight.t(), out=grad)
        return grad_nodes, *grads, None, None


class _Chunk(NamedTuple):
    """Some teams that follow each other."""

    teams: slice
    nodes: slice
    edges: tuple[np.ndarray, np.ndarray, np.ndarray, int]
    """what the compiled loops take"""

    def scratch(self, width: int) -> th.Tensor:
        """Return memory for each of the nodes."""
        return th.empty(self.nodes.stop - self.nodes.start, width)


def _chunks(graphs: TeamGraphs) -> Iterator[_Chunk]:
    teams, starts = graphs.teams.tolist(), graphs.starts.numpy()
    senders, lengths = graphs.senders.numpy(), graphs.lengths.numpy()
    for low in range(0, len(teams) - 1, _CHUNK):
        high = min(low + _CHUNK, len(teams) - 1)
        first, last = teams[low], teams[high]
        edges = (starts[first : last + 1], senders, lengths, first)
        yield _Chunk(slice(low, high), slice(first, last), edges)


def plain_hops(
    nodes: th.Tensor,
    weight: th.Tensor,
    bias: th.Tensor,
    by_length: th.Tensor,
    message: th.Tensor,
    graphs: TeamGraphs,
    n_hops: int,
) -> th.Tensor:
    """Apply the core hop after hop, by PyTorch's operations on lists of edges.

    :param nodes: float (V, c), h before any hop
    :param weight: float (c, 3 c): A, B and C side by side
    :param bias: float (3 c,): zeros, d and e
    :param by_length: float (2, c): c length, for each length
    :param message: float (c, c): D
    :param graphs: the edges
    :param n_hops: how often
    :return: float (n_hops + 1, 6 n, c), h at ``graphs.ends`` before any hop, after the first, ...
    """
    receivers, degrees = graphs.receivers(), graphs.starts.diff().clamp(min=1).unsqueeze(1)
    ends = graphs.ends.flatten()
    read = [nodes[ends]]
    for _ in range(n_hops):
        as_sender, as_receiver, own = (nodes @ weight + bias).chunk(3, dim=1)
        sent = as_sender[graphs.senders] + as_receiver[receivers] + by_length[graphs.lengths]
        total = th.zeros_like(own).index_add(0, receivers, F.relu(sent))
        nodes = F.relu(own + (total / degrees) @ message)
        read.append(nodes[ends])
    return th.stack(read)


class MessagePassing(nn.Module):
    """Encoder and core: embeddings after each hop, where the actions' edges end.

    :param width: size of a node's embedding, 16 in the paper
    :param n_hops: how often the core is applied, that is, how many edges far a node looks
    """

    def __init__(self, width: int, n_hops: int) -> None:
        super().__init__()
        self.width, self.n_hops = width, n_hops
        self.encoder = mlp(N_FEATURES, (width, width))
        self.as_sender = nn.Linear(width, width, bias=False)
        self.as_receiver = nn.Linear(width, width)
        self.by_length = nn.Linear(1, width, bias=False)
        self.own = nn.Linear(width, width)
        self.message = nn.Linear(width, width, bias=False)

    def balance(self) -> None:
        """Scale fresh weights so that embeddings keep their size over the hops of an open map.

        The same weights act at every hop: what they stretch by a half is a thousand times larger
        after 16 of them.
        """
        if self.own.weight.is_meta:
            return  # Shapes without numbers, see ``zoo.models.policy_outline``.
        free = th.ones(1, 8, 8, dtype=th.uint8, device=self.own.weight.device)
        target = th.zeros_like(free)
        target[:, ::3, ::2] = 1
        robots = th.tensor([[[1, 1], [2, 6], [5, 3], [7, 7]]])
        graphs = build_graphs(free, target, 1 - target, robots)
        with th.no_grad():
            # More than once, because lengths are added whatever the weights.
            for _ in range(4):
                sizes = self(graphs).square().mean((0, 1, 3)).sqrt()
                stretch = (sizes[-1] / sizes[0]).clamp(min=1e-6) ** (1.0 / self.n_hops)
                for layer in (self.own, self.message):
                    layer.weight.div_(stretch)

    def forward(self, graphs: TeamGraphs, compiled: bool | None = None) -> th.Tensor:
        """Embed the nodes at both ends of each action.

        :param graphs: the graphs
        :param compiled: by the compiled loop; by default where it can
        :return: float (n, 6, n_hops + 1, width), for each robot its own embeddings, before any hop,
            after the first, ..., and those of the cells that its five actions lead to
        """
        nodes = self.encoder(graphs.features)
        weight = th.cat([self.as_sender.weight, self.as_receiver.weight, self.own.weight]).t()
        bias = th.cat([th.zeros_like(self.own.bias), self.as_receiver.bias, self.own.bias])
        length = th.arange(N_LENGTHS, device=nodes.device, dtype=nodes.dtype).unsqueeze(1)
        by_length = length * self.by_length.weight.t()
        if compiled is None:
            compiled = nodes.device.type == "cpu" and nodes.dtype == th.float32
        hops = _CompiledHops.apply if compiled else plain_hops
        message = self.message.weight.t()
        read = hops(nodes, weight, bias, by_length, message, graphs, self.n_hops)
        return read.unflatten(1, (-1, graphs.ends.shape[1])).permute(1, 2, 0, 3)
