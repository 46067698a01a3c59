"""The network of ashawkey/torch-ngp: `NeRFNetwork.forward(x, d)` returns sigma [n] and rgb [n, 3].

The renderer also calls `density` to update its occupancy grid, so this method is routed as well. All cells share the
hash grid; each cell has its own networks after it. The stand-in replaces the compiled hash grid by PyTorch, and the
spherical harmonics by a frequency encoding.
"""

import itertools
import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


def encode(x: Tensor, octaves: int) -> Tensor:
    """Returns the encoding [..., d (1 + 2 octaves)] of x [..., d]; x itself comes first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


class TruncExp(torch.autograd.Function):
    """A stand-in for `activation.trunc_exp`, an exponential whose gradient is bounded."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradient * torch.exp(x.clamp(-15, 15))


class GridEncoder(nn.Module):
    """A stand-in for `gridencoder.GridEncoder`, which hashes the corners on levels larger than the table."""

    def __init__(self, num_levels=8, level_dim=2, base_resolution=16, log2_hashmap_size=14, desired_resolution=512):
        super().__init__()
        self.base_resolution, self.output_dim = base_resolution, num_levels * level_dim
        self.per_level_scale = (desired_resolution / base_resolution) ** (1 / (num_levels - 1))
        sides = [math.ceil(base_resolution * self.per_level_scale**level) + 1 for level in range(num_levels)]
        sizes = [min(2**log2_hashmap_size, side**3) for side in sides]
        self.register_buffer("offsets", torch.tensor([0, *itertools.accumulate(sizes)], dtype=torch.int32))
        self.sides, self.sizes = sides, sizes
        self.embeddings = nn.Parameter(torch.empty(sum(sizes), level_dim).uniform_(-1e-4, 1e-4))

    def forward(self, inputs: Tensor, bound: float = 1) -> Tensor:
        inputs, outputs = (inputs + bound) / (2 * bound), []
        corners = torch.tensor(list(itertools.product((0, 1), repeat=3)), device=inputs.device)
        for level, (side, size) in enumerate(zip(self.sides, self.sizes)):
            scaled = inputs * (self.base_resolution * self.per_level_scale**level - 1) + 0.5
            lower = torch.floor(scaled)
            x, y, z = (lower.long()[:, None] + corners).unbind(-1)
            index = x + side * (y + side * z)
            if side**3 > size:
                index = (x ^ y * 2654435761 ^ z * 805459861) & 0xFFFFFFFF
            part = (scaled - lower)[:, None]
            weights = torch.where(corners.bool(), part, 1 - part).prod(-1, keepdim=True)
            outputs.append((self.embeddings[self.offsets[level] + index % size] * weights).sum(1))
        return torch.cat(outputs, dim=-1)


class NeRFNetwork(nn.Module):
    """A stand-in for `nerf.network.NeRFNetwork`: a hash grid and two small networks without biases."""

    def __init__(self, hidden_dim=64, geo_feat_dim=15, num_layers=2, num_layers_color=3, bound=1):
        super().__init__()
        self.num_layers, self.num_layers_color, self.bound = num_layers, num_layers_color, bound
        self.encoder = GridEncoder(desired_resolution=512 * bound)
        sizes = [self.encoder.output_dim] + [hidden_dim] * (num_layers - 1) + [1 + geo_feat_dim]
        self.sigma_net = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in itertools.pairwise(sizes))
        sizes = [3 + 3 * 2 * 4 + geo_feat_dim] + [hidden_dim] * (num_layers_color - 1) + [3]
        self.color_net = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in itertools.pairwise(sizes))

    def density(self, x: Tensor) -> dict[str, Tensor]:
        h = self.encoder(x, bound=self.bound)
        for l in range(self.num_layers):
            h = self.sigma_net[l](h)
            if l != self.num_layers - 1:
                h = F.relu(h, inplace=True)
        return {"sigma": TruncExp.apply(h[..., 0]), "geo_feat": h[..., 1:]}

    def color(self, x: Tensor, d: Tensor, mask: Tensor | None = None, geo_feat: Tensor | None = None) -> Tensor:
        if mask is not None:
            rgbs = torch.zeros(mask.shape[0], 3, dtype=x.dtype, device=x.device)
            if not mask.any():
                return rgbs
            x, d, geo_feat = x[mask], d[mask], geo_feat[mask]
        h = torch.cat([encode(d, 4), geo_feat], dim=-1)
        for l in range(self.num_layers_color):
            h = self.color_net[l](h)
            if l != self.num_layers_color - 1:
                h = F.relu(h, inplace=True)
        h = torch.sigmoid(h)
        if mask is None:
            return h
        rgbs[mask] = h
        return rgbs

    def forward(self, x: Tensor, d: Tensor) -> tuple[Tensor, Tensor]:
        density = self.density(x)
        return density["sigma"], self.color(x, d, geo_feat=density["geo_feat"])


def main() -> None:
    torch.manual_seed(0)
    x, d = torch.rand(3000, 3) * 2 - 1, F.normalize(torch.randn(3000, 3), dim=-1)

    # Before: one network.
    model = NeRFNetwork()
    sigma, rgb = model(x, d)
    density = model.density(x)

    # After: one network per cell.
    centres = torch.rand(16, 3) * 2 - 1
    options = {"methods": ["density"], "share": ["encoder.*"], "fuse": True}
    model = VoronoiRouter(model, centres, coords="first3", **options)
    routed_sigma, routed_rgb = model(x, d)
    routed_density = model.density(x)

    torch.testing.assert_close((routed_sigma, routed_rgb, routed_density), (sigma, rgb, density))
    assert model.explain().startswith("forward: fused in runs")
    shapes = [list(model.module.get_parameter(name).shape) for name in ("encoder.embeddings", "sigma_net.0.weight")]
    print(f"one hash grid {shapes[0]} for all cells, sigma_net {shapes[1]}")
    print(f"torch-ngp: {model.num_cells} cells, sigma {list(routed_sigma.shape)}, rgb {list(routed_rgb.shape)}")


if __name__ == "__main__":
    main()
