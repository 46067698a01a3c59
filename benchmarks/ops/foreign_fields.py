"""Stand-ins for the fields of other codebases, each in the style of its original.

No field knows of cells. n samples; R components of a plane; T entries of a table, f features of an entry.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def example(name: str) -> ModuleType:
    """Imports the script `name` from `examples/`, which has a stand-in for a codebase."""
    full = f"examples_{name}"
    if full not in sys.modules:
        spec = importlib.util.spec_from_file_location(full, EXAMPLES / f"{name}.py")
        assert spec is not None and spec.loader is not None
        sys.modules[full] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[full])
    return sys.modules[full]


frequencies = example("nerf_pytorch").encode
"""A function (x [n, d], octaves) that returns x followed by sine and cosine of each octave, [n, d (1 + 2 octaves)]."""


def nerf(width: int = 64) -> nn.Module:
    """Returns the network of nerf-pytorch: eight layers on encoded inputs, a skip connection after the fifth."""
    module: nn.Module = example("nerf_pytorch").NeRF(W=width, input_ch=63, input_ch_views=27, use_viewdirs=True)
    return module


def skip_net(points: int = 9, views: int = 6) -> nn.Module:
    """Returns a small network of nerf-pytorch."""
    sizes = {"D": 4, "W": 12, "input_ch": points, "input_ch_views": views, "skips": [2]}
    module: nn.Module = example("nerf_pytorch").NeRF(**sizes, use_viewdirs=True)
    return module


def mega_nerf() -> nn.Module:
    """Returns the network of Mega-NeRF, whose last input is an image's number, for an appearance code per image."""
    module: nn.Module = example("mega_nerf").NeRF(layer_dim=64, appearance_count=100)
    return module


class VanillaField(example("nerfacc_field").VanillaNeRFRadianceField):
    """The field of nerfacc: encoders inside, a base with a skip connection, density and colour heads."""

    def __init__(self) -> None:
        super().__init__(net_depth=4, net_width=64, skip_layer=2, net_width_condition=32)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        return torch.cat(super().forward(x, condition), dim=-1)


class Sine(nn.Module):
    """A SIREN layer, ``sin(30 * (W x + b))``."""

    def __init__(self, inputs: int, outputs: int, first: bool) -> None:
        super().__init__()
        self.linear, self.omega = nn.Linear(inputs, outputs), 30.0
        bound = 1 / inputs if first else math.sqrt(6 / inputs) / self.omega
        nn.init.uniform_(self.linear.weight, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(self.omega * self.linear(x))


class Siren(nn.Module):
    """A SIREN: four sine layers and a linear layer."""

    def __init__(self, width: int = 64, outputs: int = 4) -> None:
        super().__init__()
        layers = [Sine(3 if i == 0 else width, width, i == 0) for i in range(4)]
        self.net = nn.Sequential(*layers, nn.Linear(width, outputs))
        nn.init.uniform_(self.net[4].weight, -math.sqrt(6 / width) / 30, math.sqrt(6 / width) / 30)

    def forward(self, coords: Tensor) -> Tensor:
        return cast(Tensor, self.net(coords))


class SignedDistance(nn.Module):
    """The SDF network of NeuS: softplus layers on encoded positions, a skip connection, initialised near a sphere."""

    def __init__(self, width: int = 64, depth: int = 4, skip: int = 2) -> None:
        super().__init__()
        self.depth, self.skip = depth, skip
        for i in range(depth + 1):
            inputs = 39 if i == 0 else width
            outputs = 1 if i == depth else width - 39 if i + 1 == skip and width > 39 else width
            layer = nn.Linear(inputs, outputs)
            nn.init.normal_(layer.weight, 0.0, math.sqrt(2) / math.sqrt(outputs))
            setattr(self, f"lin{i}", layer)
        self.activation = nn.Softplus(beta=100)

    def forward(self, inputs: Tensor) -> Tensor:
        x = inputs = frequencies(inputs, 6)
        for i in range(self.depth + 1):
            if i == self.skip:
                x = torch.cat([x, inputs], 1) / math.sqrt(2)
            x = getattr(self, f"lin{i}")(x)
            if i < self.depth:
                x = self.activation(x)
        return x


class Encoded(nn.Module):
    """A field of an encoding, which cells may share, and a small head."""

    def decode(self, features: Tensor) -> Tensor:
        return cast(Tensor, self.head(features))

    def forward(self, x: Tensor) -> Tensor:
        return self.decode(self.encode(x))


class HashTable(Encoded):
    """The hash encoding of nerfacto in torch: ``table[index]`` for eight corners of all levels, and a small head."""

    scalings: Tensor
    offsets: Tensor

    def __init__(self, entries: int = 1 << 14, levels: int = 16, width: int = 64) -> None:
        super().__init__()
        self.entries, self.levels = entries, levels
        growth = math.exp((math.log(1024) - math.log(16)) / (levels - 1))
        self.register_buffer("scalings", torch.floor(16 * growth ** torch.arange(levels)))
        self.register_buffer("offsets", torch.arange(levels) * entries)
        self.hash_table = nn.Parameter((torch.rand(entries * levels, 2) * 2 - 1) * 1e-1)
        self.head = nn.Sequential(nn.Linear(levels * 2, width), nn.ReLU(), nn.Linear(width, 4))

    def hash_fn(self, corner: Tensor) -> Tensor:
        corner = corner * torch.tensor([1, 2654435761, 805459861], device=corner.device)
        x = torch.bitwise_xor(corner[..., 0], corner[..., 1])
        x = torch.bitwise_xor(x, corner[..., 2])
        x %= self.entries
        x += self.offsets
        return x

    def encode(self, positions: Tensor) -> Tensor:
        positions = (positions + 1) / 2
        scaled = positions[..., None, :] * self.scalings.view(-1, 1)
        c, f = torch.ceil(scaled).type(torch.int32), torch.floor(scaled).type(torch.int32)
        offset = scaled - f
        corners = []
        for corner in range(8):
            x, y, z = [(c if corner >> axis & 1 else f)[..., axis : axis + 1] for axis in range(3)]
            corners.append(self.hash_table[self.hash_fn(torch.cat([x, y, z], dim=-1))])
        for axis in range(3):
            w = offset[..., axis : axis + 1]
            corners = [a * (1 - w) + b * w for a, b in zip(corners[::2], corners[1::2])]
        return torch.flatten(corners[0], start_dim=-2, end_dim=-1)


class HashEmbedder(Encoded):
    """The encoding of HashNeRF: one ``nn.Embedding`` per level, looked up at eight corners, and a small head."""

    def __init__(self, entries: int = 1 << 14, levels: int = 16, width: int = 64) -> None:
        super().__init__()
        self.entries, self.levels = entries, levels
        self.growth = math.exp((math.log(512) - math.log(16)) / (levels - 1))
        self.embeddings = nn.ModuleList([nn.Embedding(entries, 2) for _ in range(levels)])
        for table in self.embeddings:
            nn.init.uniform_(table.weight, a=-0.1, b=0.1)
        self.head = nn.Sequential(nn.Linear(levels * 2, width), nn.ReLU(), nn.Linear(width, 4))

    def hash(self, coords: Tensor) -> Tensor:
        xor = coords[..., 0] * 1 ^ coords[..., 1] * 2654435761 ^ coords[..., 2] * 805459861
        return torch.tensor(self.entries - 1, device=coords.device) & xor

    def encode(self, x: Tensor) -> Tensor:
        x, levels = (x + 1) / 2, []
        box = torch.tensor([[[i, j, k] for i in [0, 1] for j in [0, 1] for k in [0, 1]]], device=x.device)
        for i in range(self.levels):
            scaled = x * math.floor(16 * self.growth**i)
            bottom = torch.floor(scaled).int()
            weights = scaled - bottom
            voxel = self.embeddings[i](self.hash(bottom.unsqueeze(1) + box))
            for axis in range(3):
                half, w = voxel.shape[1] // 2, weights[:, axis][:, None, None]
                voxel = voxel[:, :half] * (1 - w) + voxel[:, half:] * w
            levels.append(voxel[:, 0])
        return torch.cat(levels, dim=-1)


class GridEncoder(nn.Module):
    """The hash grid of torch-ngp: one table, whose small levels are dense with (resolution + 1)^3 entries."""

    def __init__(self, entries: int = 1 << 19, levels: int = 16, finest: int = 2048) -> None:
        super().__init__()
        self.growth = (finest / 16) ** (1 / (levels - 1))
        sizes = [min(entries, (math.ceil(16 * self.growth**level) + 1) ** 3) for level in range(levels)]
        self.offsets = [sum(sizes[:level]) for level in range(levels + 1)]
        self.embeddings = nn.Parameter(torch.rand(self.offsets[-1], 2) * 0.2 - 0.1)

    def forward(self, inputs: Tensor, bound: float = 1.0) -> Tensor:
        inputs = (inputs + bound) / (2 * bound)
        box = torch.tensor([[i, j, k] for i in [0, 1] for j in [0, 1] for k in [0, 1]], device=inputs.device)
        places, shares = [], []
        for level, (start, stop) in enumerate(zip(self.offsets, self.offsets[1:])):
            scale = 16 * self.growth**level - 1
            side, scaled = math.ceil(scale) + 2, inputs * scale + 0.5
            corner = torch.floor(scaled)
            x, y, z = (corner.long()[:, None] + box).unbind(-1)
            hashed = (x ^ y * 2654435761 ^ z * 805459861) & 0xFFFFFFFF
            dense = side**3 <= stop - start
            places.append(start + (x + side * (y + side * z) if dense else hashed) % (stop - start))
            shares.append(torch.where(box.bool(), (scaled - corner)[:, None], 1 - (scaled - corner)[:, None]).prod(-1))
        found = self.embeddings[torch.stack(places, 1)] * torch.stack(shares, 1)[..., None]
        return found.sum(2).flatten(1)


class NeRFNetwork(nn.Module):
    """The network of torch-ngp: a hash grid, two density layers and three colour layers without biases."""

    def __init__(self, entries: int = 1 << 19, levels: int = 16, width: int = 64) -> None:
        super().__init__()
        self.encoder = GridEncoder(entries, levels)
        sizes = [(2 * levels, width), (width, 16)]
        self.sigma_net = nn.ModuleList([nn.Linear(i, o, bias=False) for i, o in sizes])
        sizes = [(27 + 15, width), (width, width), (width, 3)]
        self.color_net = nn.ModuleList([nn.Linear(i, o, bias=False) for i, o in sizes])

    def encode(self, x: Tensor) -> Tensor:
        return cast(Tensor, self.encoder(x))

    def decode(self, h: Tensor, d: Tensor) -> Tensor:
        for i, layer in enumerate(self.sigma_net):
            h = layer(h)
            if i == 0:
                h = F.relu(h, inplace=True)
        sigma, h = torch.exp(h[..., :1]), torch.cat([frequencies(d, 4), h[..., 1:]], dim=-1)
        for i, layer in enumerate(self.color_net):
            h = layer(h)
            if i < 2:
                h = F.relu(h, inplace=True)
        return torch.cat([torch.sigmoid(h), sigma], dim=-1)

    def forward(self, x: Tensor, d: Tensor) -> Tensor:
        return self.decode(self.encode(x), d)


class TensorField(Encoded):
    """The vector-matrix factors of TensoRF: planes and lines read by ``F.grid_sample``."""

    def __init__(self, size: int = 64, components: int = 16, width: int = 64) -> None:
        super().__init__()
        self.mat_mode, self.vec_mode = [[0, 1], [0, 2], [1, 2]], [2, 1, 0]
        self.plane = nn.ParameterList([nn.Parameter(0.1 * torch.randn(1, components, size, size)) for _ in range(3)])
        self.line = nn.ParameterList([nn.Parameter(0.1 * torch.randn(1, components, size, 1)) for _ in range(3)])
        self.basis_mat = nn.Linear(3 * components, 27, bias=False)
        self.head = nn.Sequential(nn.Linear(27, width), nn.ReLU(), nn.Linear(width, 4))

    def encode(self, xyz: Tensor) -> Tensor:
        plane = torch.stack([xyz[..., mode] for mode in self.mat_mode]).detach().view(3, -1, 1, 2)
        line = torch.stack([xyz[..., mode] for mode in self.vec_mode])
        line = torch.stack((torch.zeros_like(line), line), dim=-1).detach().view(3, -1, 1, 2)
        planes, lines = [], []
        for i in range(3):
            planes.append(F.grid_sample(self.plane[i], plane[[i]], align_corners=True).view(-1, *xyz.shape[:1]))
            lines.append(F.grid_sample(self.line[i], line[[i]], align_corners=True).view(-1, *xyz.shape[:1]))
        return (torch.cat(planes) * torch.cat(lines)).T

    def decode(self, features: Tensor) -> Tensor:
        return cast(Tensor, self.head(self.basis_mat(features)))


class KPlanes(Encoded):
    """The field of K-Planes: products of plane features at several resolutions, and a small head."""

    def __init__(self, sizes: tuple[int, ...] = (32, 64), components: int = 16, width: int = 64) -> None:
        super().__init__()
        self.grids = nn.ModuleList(
            nn.ParameterList([nn.Parameter(torch.rand(1, components, size, size) * 0.4 + 0.1) for _ in range(3)])
            for size in sizes
        )
        self.head = nn.Sequential(nn.Linear(len(sizes) * components, width), nn.ReLU(), nn.Linear(width, 4))

    def encode(self, pts: Tensor) -> Tensor:
        features = []
        for grids in self.grids:
            product: Tensor | float = 1.0
            for plane, pair in zip(grids, ((0, 1), (0, 2), (1, 2))):
                coords = pts[..., pair].view(1, -1, 1, 2)
                found = F.grid_sample(plane, coords, align_corners=True, mode="bilinear", padding_mode="border")
                product = product * found.view(1, plane.shape[1], -1).transpose(-1, -2).squeeze(0)
            features.append(product)
        return torch.cat(features, dim=-1)


class SplineLayer(nn.Module):
    """A KAN layer: a cubic B-spline for each pair of input and output, contracted by ``einsum``."""

    grid: Tensor

    def __init__(self, inputs: int, outputs: int, intervals: int = 5, order: int = 3) -> None:
        super().__init__()
        self.order = order
        knots = torch.arange(-order, intervals + order + 1) * (2 / intervals) - 1
        self.register_buffer("grid", knots.expand(inputs, -1).contiguous())
        self.base_weight = nn.Parameter(torch.randn(outputs, inputs) / math.sqrt(inputs))
        self.spline_weight = nn.Parameter(torch.randn(outputs, inputs, intervals + order) * 0.3 / math.sqrt(inputs))

    def b_splines(self, x: Tensor) -> Tensor:
        x, grid = x.unsqueeze(-1), self.grid
        bases = ((x >= grid[:, :-1]) & (x < grid[:, 1:])).to(x.dtype)
        for k in range(1, self.order + 1):
            left = (x - grid[:, : -(k + 1)]) / (grid[:, k:-1] - grid[:, : -(k + 1)]) * bases[:, :, :-1]
            right = (grid[:, k + 1 :] - x) / (grid[:, k + 1 :] - grid[:, 1:-k]) * bases[:, :, 1:]
            bases = left + right
        return bases

    def forward(self, x: Tensor) -> Tensor:
        base = F.linear(F.silu(x), self.base_weight)
        return base + torch.einsum("nig,oig->no", self.b_splines(x), self.spline_weight)


class KAN(nn.Module):
    """A KAN of three spline layers."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.layers = nn.ModuleList([SplineLayer(3, width), SplineLayer(width, width), SplineLayer(width, 4)])

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers:
            x = layer(x)
        return x


class Activated(nn.Module):
    """A plain network with any activation between its layers: instant-nsr (SiLU), IBRNet (ELU), IDR (LeakyReLU)."""

    def __init__(self, activation: nn.Module, width: int = 64, outputs: int = 4) -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(39 if i == 0 else width, width) for i in range(4)])
        self.activation, self.head = activation, nn.Linear(width, outputs)

    def forward(self, x: Tensor) -> Tensor:
        x = frequencies(x, 6)
        for layer in self.layers:
            x = self.activation(layer(x))
        return cast(Tensor, self.head(x))


class DNeRF(nn.Module):
    """The field of D-NeRF: a network deforms the positions, which are encoded again for the second network."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.time = nn.Sequential(
            nn.Linear(40, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU(), nn.Linear(width, 3)
        )
        self.layers = nn.ModuleList([nn.Linear(39 if i == 0 else width, width) for i in range(3)])
        self.head = nn.Linear(width, 4)

    def forward(self, x: Tensor) -> Tensor:
        moved = x + self.time(torch.cat([frequencies(x, 6), torch.ones_like(x[..., :1]) * 0.5], -1))
        h = frequencies(moved, 6)
        for layer in self.layers:
            h = F.relu(layer(h), inplace=True)
        return torch.cat([torch.sigmoid(self.head(h)[..., :3]), F.softplus(self.head(h)[..., 3:] - 1)], -1)


class Bacon(nn.Module):
    """The field of BACON: layers multiplied by sines of the position."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.filters = nn.ModuleList([nn.Linear(3, width) for _ in range(4)])
        self.layers = nn.ModuleList([nn.Linear(width, width) for _ in range(3)])
        self.head = nn.Linear(width, 4)

    def forward(self, x: Tensor) -> Tensor:
        out = torch.sin(self.filters[0](x))
        for filter, layer in zip(list(self.filters)[1:], self.layers):
            out = torch.sin(filter(x)) * layer(out)
        return cast(Tensor, self.head(out))


class FiLM(nn.Module):
    """The layers of pi-GAN: sines whose frequency and phase come from a code."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.layers = nn.ModuleList([nn.Linear(3 if i == 0 else width, width) for i in range(4)])
        self.frequencies, self.shifts = nn.Parameter(torch.rand(4, width)), nn.Parameter(torch.rand(4, width))
        self.head = nn.Linear(width, 4)

    def forward(self, x: Tensor) -> Tensor:
        for i, layer in enumerate(self.layers):
            h = layer(x)
            x = torch.sin(self.frequencies[i].unsqueeze(0).expand_as(h) * 15 * h + self.shifts[i])
        return cast(Tensor, self.head(x))


class Normed(nn.Module):
    """The ResBlocks of stable-dreamfusion: LayerNorm, SiLU, skip connections."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.first, self.head = nn.Linear(39, width), nn.Linear(width, 4)
        self.dense = nn.ModuleList([nn.Linear(width, width) for _ in range(3)])
        self.norm = nn.ModuleList([nn.LayerNorm(width) for _ in range(3)])

    def forward(self, x: Tensor) -> Tensor:
        h = self.first(frequencies(x, 6))
        for dense, norm in zip(self.dense, self.norm):
            h = F.silu(norm(dense(h)) + h)
        return cast(Tensor, self.head(h))


class LearnedSine(nn.Module):
    """A small network with sines of scaled layers, a learned frequency and a residual block."""

    def __init__(self) -> None:
        super().__init__()
        self.a, self.b, self.out = nn.Linear(3, 8), nn.Linear(8, 8), nn.Linear(8, 2, bias=False)
        self.frequency = nn.Parameter(torch.tensor(3.0))
        self.scale = nn.Parameter(torch.rand(8) + 0.5)

    def forward(self, x: Tensor) -> Tensor:
        h = torch.sin(self.frequency * self.a(x))
        h = h + torch.sin(self.b(h)) * self.scale
        return cast(Tensor, self.out(h))


class Heads(nn.Module):
    """A small field with flags, an optional argument, results of one dimension, and the methods that renderers call."""

    def __init__(self) -> None:
        super().__init__()
        self.net = nn.Sequential(nn.Linear(3, 8), nn.SiLU(), nn.Linear(8, 5))
        self.colour = nn.Sequential(nn.Linear(4 + 3, 6, bias=False), nn.ReLU(inplace=True), nn.Linear(6, 3))
        self.register_buffer("bands", 2.0 ** torch.arange(2))

    def forward(self, x: Tensor, d: Tensor | None = None, density_only: bool = False) -> Any:
        result = self.density(x)
        if density_only or d is None:
            return result["sigma"]
        return self.color(x, d, result["features"]), result["sigma"]

    def density(self, x: Tensor) -> dict[str, Tensor]:
        h = self.net(x)
        return {"sigma": torch.exp(h[..., 0].clamp(max=4)), "features": h[..., 1:]}

    def color(self, x: Tensor, d: Tensor, features: Tensor) -> Tensor:
        return torch.sigmoid(self.colour(torch.cat([d, features], -1)))
