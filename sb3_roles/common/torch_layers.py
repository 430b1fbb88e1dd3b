"""Network parts: map encoders, graph layer, role-conditioned heads; none depends on team size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch as th
from torch import nn
from torch.nn import functional as F

from sb3_roles.common.names import closest

NORM_LAYERS = ("none", "frozen_batch", "group")
PRECISIONS = ("auto", "fp32", "bf16")

# (kernel, stride, padding) of each convolution, pooling behind the first one, and the grid that is
# left of any map: the released code's networks, which reduce 9 x 9 and 25 x 25 maps to 1 x 1.
_STYLES: dict[str, tuple[tuple[tuple[int, int, int], ...], bool, int]] = {
    "local": (((4, 2, 2), (4, 2, 2), (3, 2, 0)), False, 1),
    "joint": (((5, 2, 2), (3, 2, 1), (3, 2, 1), (3, 2, 1)), True, 1),
    "state": (((4, 2, 1), (4, 2, 1), (4, 2, 1)), False, 2),
}
CHANNELS = {"local": (8, 16, 32), "joint": (16, 32, 64, 64), "state": (8, 16, 32)}
# Smaller maps are padded: each convolution then has at least 2 x 2 cells to read. (On 1 x 1 cells,
# PyTorch's bfloat16 convolution on CPUs returns weight gradients of uninitialized memory.)
_MIN_SIDE = {"local": 6, "joint": 19, "state": 8}


class FrozenBatchNorm2d(nn.BatchNorm2d):
    """Batch normalization whose statistics change only inside :func:`updating_statistics`.

    Collecting with one normalization and training with another would make the probability ratio
    differ from 1 before any step; here both passes use the statistics of before the rollout.
    """

    def train(self, mode: bool = True) -> FrozenBatchNorm2d:
        """Stay in evaluation mode, whatever the policy does."""
        return super().train(False)

    def forward(self, maps: th.Tensor) -> th.Tensor:
        """Normalize; a single value per channel has no statistics and changes none."""
        if self.training and maps.numel() // maps.shape[1] < 2:
            nn.BatchNorm2d.train(self, False)
        return super().forward(maps)


@contextmanager
def updating_statistics(module: nn.Module) -> Iterator[bool]:
    """Let forward passes update the statistics of all frozen normalization layers.

    :param module: the networks
    :return: whether there is any such layer
    """
    layers = [layer for layer in module.modules() if isinstance(layer, FrozenBatchNorm2d)]
    for layer in layers:
        nn.BatchNorm2d.train(layer, True)
    try:
        yield bool(layers)
    finally:
        for layer in layers:
            nn.BatchNorm2d.train(layer, False)


def make_norm(norm_layer: str, channels: int) -> nn.Module:
    """Return the normalization behind a convolution.

    :param norm_layer: ``"none"``, ``"frozen_batch"`` or ``"group"``
    :param channels: channels of the convolution
    :raises ValueError: if the name is unknown
    """
    if norm_layer == "none":
        return nn.Identity()
    if norm_layer == "frozen_batch":
        return FrozenBatchNorm2d(channels)
    if norm_layer == "group":
        return nn.GroupNorm(max(1, channels // 8), channels)
    raise ValueError(closest("norm_layer", norm_layer, NORM_LAYERS))


class MapEncoder(nn.Module):
    """Overlapping convolutions over a map of any size, to a vector: the released code's encoders.

    :param in_channels: channels of the map
    :param style: ``"local"``, ``"joint"`` or ``"state"``: the released code's three encoders
    :param channels: output channels of each convolution
    :param norm_layer: see :func:`make_norm`; only the joint encoder has it, as in the paper
    :raises ValueError: if the number of channels does not fit the style
    """

    def __init__(
        self, in_channels: int, style: str, channels: Sequence[int], norm_layer: str = "none"
    ) -> None:
        super().__init__()
        convolutions, pool, self.grid = _STYLES[style]
        if len(channels) != len(convolutions):
            raise ValueError(
                f"the {style} encoder has {len(convolutions)} convolutions, "
                f"got channels {list(channels)}"
            )
        self.min_side = _MIN_SIDE[style]
        layers: list[nn.Module] = []
        width = in_channels
        for k, ((kernel, stride, padding), out) in enumerate(
            zip(convolutions, channels, strict=True)
        ):
            layers.append(nn.Conv2d(width, out, kernel, stride, padding))
            if style == "joint":
                layers.append(make_norm(norm_layer, out))
            layers.append(nn.ReLU(inplace=True))
            if pool and k == 0:
                layers.append(nn.MaxPool2d(2))
            width = out
        self.layers = nn.Sequential(*layers)
        self.out_features = width * self.grid * self.grid

    def forward(self, maps: th.Tensor) -> th.Tensor:
        """Encode maps.

        :param maps: any dtype (n, in_channels, height, width)
        :return: float (n, out_features)
        """
        maps = maps.to(_compute_dtype(maps))
        short = [max(0, self.min_side - side) for side in maps.shape[-2:]]
        if any(short):
            maps = F.pad(maps, (0, short[1], 0, short[0]))
        encoded = self.layers(maps)
        if encoded.shape[-2:] != (self.grid, self.grid):
            encoded = F.adaptive_avg_pool2d(encoded, self.grid)
        return encoded.flatten(1)


class PatchEncoder(nn.Module):
    """Patches of a map of any size, embedded one by one, then mixed by a dense layer.

    A CPU spends several times less on it than on overlapping convolutions with few channels.
    A map of another size than the reference has another number of patches; their embeddings are
    averaged to the reference grid.

    :param in_channels: channels of the map
    :param patch: side of a patch
    :param grid: patches along a side of the reference map
    :param channels: size of a patch's embedding, of the mixing layer, and of the output
    """

    def __init__(self, in_channels: int, patch: int, grid: int, channels: Sequence[int]) -> None:
        super().__init__()
        if len(channels) != 3:
            raise ValueError(f"a patch encoder has three layers, got channels {list(channels)}")
        self.patch, self.grid = patch, grid
        self.embed = nn.Linear(in_channels * patch * patch, channels[0])
        self.mix = mlp(channels[0] * grid * grid, channels[1:])
        self.out_features = channels[2]

    def fits(self, maps: th.Tensor) -> bool:
        """Whether maps, (n, in_channels, height, width), have ``grid * grid`` patches."""
        return maps.ndim == 4 and all(
            -(-side // self.patch) == self.grid for side in maps.shape[2:]
        )

    def cut(self, maps: th.Tensor) -> th.Tensor:
        """Cut maps into patches, row by row; sides that are no multiples are filled with 0.

        :param maps: any dtype (n, in_channels, height, width), best with channels last in memory
        :return: the same dtype (n, rows, columns, patch * patch * in_channels)
        """
        patch = self.patch
        last = maps.permute(0, 2, 3, 1)
        n, height, width, channels = last.shape
        missing = (-height % patch, -width % patch)
        if any(missing):
            last = F.pad(last, (0, 0, 0, missing[1], 0, missing[0]))
        rows, columns = last.shape[1] // patch, last.shape[2] // patch
        patches = last.reshape(n, rows, patch, columns, patch, channels).transpose(2, 3)
        return patches.reshape(n, rows, columns, -1)

    def forward(self, maps: th.Tensor) -> th.Tensor:
        """Encode maps.

        :param maps: as :meth:`cut` takes them; or as it returns them, with rows and columns merged,
            for maps of ``grid * grid`` patches
        :return: float (n, out_features)
        """
        grid = self.grid
        patches = maps.unflatten(1, (grid, grid)) if maps.ndim == 3 else self.cut(maps)
        # Rearranged as bytes, and only then widened.
        embedded = F.relu(self.embed(patches.to(_compute_dtype(maps))), inplace=True)
        if embedded.shape[1:3] != (grid, grid):
            pooled = F.adaptive_avg_pool2d(embedded.permute(0, 3, 1, 2), grid)
            embedded = pooled.permute(0, 2, 3, 1)
        return self.mix(embedded.flatten(1))


# Maps up to this side are read as a robot's own view, larger ones as a team's.
_SMALL_MAP = 12


def map_style(key: str, shape: Sequence[int]) -> str:
    """Say which kind of map an observation key is.

    :param key: a name of ``CHANNELS`` is the kind itself
    :param shape: channels, height and width
    :return: ``"local"``, ``"joint"`` or ``"state"``
    """
    if key in CHANNELS:
        return key
    return "local" if min(shape[1:]) <= _SMALL_MAP else "joint"


# Patch side, patches along a side of the paper's maps, and channels, by kind of map.
_PATCHES = {"local": (3, 3), "joint": (5, 5), "state": (5, 5)}
PATCH_CHANNELS = {"local": (16, 64, 32), "joint": (32, 128, 64), "state": (32, 128, 64)}
ENCODERS = ("convolutions", "patches")


def make_map_encoder(
    encoder: str, style: str, in_channels: int, channels: Sequence[int] | None, norm_layer: str
) -> MapEncoder | PatchEncoder:
    """Create the encoder of one kind of map.

    :param encoder: ``"convolutions"`` (the released code's) or ``"patches"``
    :param style: ``"local"``, ``"joint"`` or ``"state"``
    :param in_channels: channels of the map
    :param channels: sizes of the layers; None for the default of the kind
    :param norm_layer: see :func:`make_norm`
    :raises ValueError: if a name is unknown, or the number of channels does not fit
    """
    if encoder not in ENCODERS:
        raise ValueError(closest("encoder", encoder, ENCODERS))
    if encoder == "convolutions":
        return MapEncoder(in_channels, style, channels or CHANNELS[style], norm_layer)
    if norm_layer != "none":
        raise ValueError("norm_layer is for encoder='convolutions'; patches have none")
    return PatchEncoder(in_channels, *_PATCHES[style], channels or PATCH_CHANNELS[style])


def _compute_dtype(maps: th.Tensor) -> th.dtype:
    kind = maps.device.type
    return th.get_autocast_dtype(kind) if th.is_autocast_enabled(kind) else th.float32


def symlog(x: th.Tensor) -> th.Tensor:
    """Compress a quantity without bounds: sign(x) log(1 + abs(x))."""
    return x.sign() * x.abs().log1p()


def mlp(in_features: int, widths: Sequence[int]) -> nn.Sequential:
    """Linear layers, each with a ReLU behind it.

    :param in_features: size of the input
    :param widths: size of each layer
    """
    layers: list[nn.Module] = []
    for width in widths:
        layers += [nn.Linear(in_features, width), nn.ReLU(inplace=True)]
        in_features = width
    return nn.Sequential(*layers)


class Head(nn.Module):
    """An MLP with a linear output.

    :param in_features: size of the input
    :param widths: sizes of the hidden layers
    :param out_features: size of the output
    :param gain: scale of the output layer's orthogonal initialization
    """

    def __init__(
        self, in_features: int, widths: Sequence[int], out_features: int, gain: float
    ) -> None:
        super().__init__()
        self.hidden = mlp(in_features, widths)
        self.out = nn.Linear(widths[-1] if widths else in_features, out_features)
        self.gain = gain

    def forward(self, x: th.Tensor) -> th.Tensor:
        """Map (n, in_features) to (n, out_features)."""
        return self.out(self.hidden(x))


class RoleHead(nn.Module):
    """A head on the concatenation of features and a one-hot role (Section V-B).

    The first layer is computed as features' part + role's part, which is the same as on the
    concatenation, and lets one pass serve all roles.

    :param in_features: size of the features
    :param n_roles: number of roles
    :param widths: sizes of the hidden layers, at least one
    :param out_features: size of the output
    :param gain: scale of the output layer's orthogonal initialization
    """

    def __init__(
        self,
        in_features: int,
        n_roles: int,
        widths: Sequence[int],
        out_features: int,
        gain: float,
    ) -> None:
        super().__init__()
        if not widths:
            raise ValueError("a role-conditioned head needs at least one hidden layer")
        self.features = nn.Linear(in_features, widths[0])
        self.role = nn.Linear(n_roles, widths[0], bias=False)
        self.head = Head(widths[0], widths[1:], out_features, gain)

    def forward(self, x: th.Tensor, roles: th.Tensor | None = None) -> th.Tensor:
        """Evaluate for one role per row, or for all of them.

        :param x: float (n, in_features)
        :param roles: int64 (n,); None for all roles
        :return: float (n, out_features), or (n, n_roles, out_features)
        """
        first = self.features(x)
        if roles is None:
            return self.head(F.relu(first.unsqueeze(1) + self.role.weight.t()))
        # A product with one-hots: the backward pass of indexing is ten times slower.
        one_hot = F.one_hot(roles, self.role.in_features).to(first.dtype)
        return self.head(F.relu(first + self.role(one_hot)))


class GoalPrior(nn.Module):
    """Logits that favor the moves towards sub-goals, with a learned weight for each sub-goal.

    :param weights: first weights, float (n_goals,), or (n_roles, n_goals) if they differ by role
    :param n_moves: number of moves
    """

    def __init__(self, weights: th.Tensor, n_moves: int) -> None:
        super().__init__()
        self.weights = nn.Parameter(weights)
        self.n_moves = n_moves

    def forward(self, goals: th.Tensor, roles: th.Tensor | None = None) -> th.Tensor:
        """Weigh the moves.

        :param goals: (n, n_goals, n_moves or more), rows that begin with a flag for each move, 1
            for one with which a shortest path begins
        :param roles: int64 (n,), if the weights differ by role; None for all roles
        :return: float (n, n_moves), or (n, n_roles, n_moves)
        """
        flags = goals[..., : self.n_moves].float()
        if self.weights.ndim == 1 or roles is None:
            return th.einsum("...g,ngm->n...m", self.weights, flags)
        one_hot = F.one_hot(roles, len(self.weights)).to(flags.dtype)
        return ((one_hot @ self.weights).unsqueeze(2) * flags).sum(1)


class GraphLayer(nn.Module):
    """One round of messages between team mates: ReLU(W0 x_i + W1 sum_j S_ij x_j).

    :param in_features: size of a robot's features
    :param out_features: size of the output
    """

    def __init__(self, in_features: int, out_features: int) -> None:
        super().__init__()
        self.own = nn.Linear(in_features, out_features)
        self.others = nn.Linear(in_features, out_features, bias=False)

    def forward(self, x: th.Tensor, graph: th.Tensor) -> th.Tensor:
        """Pass messages.

        :param x: float (n_teams, n_agents, in_features)
        :param graph: float (n_teams, n_agents, n_agents), S
        :return: float (n_teams, n_agents, out_features)
        """
        messages = th.bmm(graph, x)
        return F.relu(self.own(x) + self.others(messages))


def communication_graph(
    position: th.Tensor | None, radius: float | None, like: th.Tensor
) -> th.Tensor:
    """Return S = D^-1/2 A D^-1/2, where A links robots strictly nearer than a radius.

    :param position: float (n_teams, n_agents, 2); None links all robots of a team
    :param radius: communication radius in the unit of ``position``; None links all
    :param like: float (n_teams, n_agents, any): gives shape and device
    :return: float32 (n_teams, n_agents, n_agents), zero on the diagonal
    """
    n_agents = like.shape[1]
    apart = ~th.eye(n_agents, dtype=th.bool, device=like.device)
    if position is None or radius is None:
        linked = apart.expand(like.shape[0], n_agents, n_agents).float()
    else:
        # Coordinates are small whole numbers for a grid: this distance is exact.
        offset = position.unsqueeze(2) - position.unsqueeze(1)
        near = offset.square().sum(-1) < radius * radius
        linked = (near & apart).float()
    scale = linked.sum(-1).clamp(min=1.0).rsqrt()
    return scale.unsqueeze(2) * linked * scale.unsqueeze(1)


def has_fast_bfloat16() -> bool:
    """Whether this CPU multiplies bfloat16 matrices in hardware."""
    with_amx = getattr(th.cpu, "_is_amx_tile_supported", lambda: False)()
    with_avx = getattr(th.cpu, "_is_avx512_bf16_supported", lambda: False)()
    return bool(with_amx or with_avx)


def resolve_precision(precision: str, device: th.device | str) -> str:
    """Turn ``"auto"`` into what pays on a device.

    :param precision: ``"auto"``, ``"fp32"`` or ``"bf16"``
    :param device: where the networks are
    :return: ``"fp32"`` or ``"bf16"``
    :raises ValueError: if the name is unknown
    """
    if precision not in PRECISIONS:
        raise ValueError(closest("precision", precision, PRECISIONS))
    if precision != "auto":
        return precision
    on_cpu = th.device(device).type == "cpu"
    return "bf16" if (has_fast_bfloat16() if on_cpu else th.cuda.is_bf16_supported()) else "fp32"
