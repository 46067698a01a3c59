"""ashawkey/torch-ngp: `NeRFNetwork.forward(x, d)` -> sigma [n], rgb [n, 3]; `density(x)` -> a dict; `color(x, d, ...)`.

The renderer asks `density` to update its occupancy grid, so that is routed as well. The hash grid of the original is a
compiled extension; a frequency encoding stands in its place, as its `encoding="frequency"` does.
"""

import itertools

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


def encode(x: Tensor, octaves: int) -> Tensor:
    """[..., d] -> [..., d (1 + 2 octaves)], x itself first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


class TruncExp(torch.autograd.Function):
    """Stands for `activation.trunc_exp`: an exponential whose gradient is bounded."""

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return torch.exp(x)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradient * torch.exp(x.clamp(-15, 15))


class NeRFNetwork(nn.Module):
    """Stands for `nerf.network_ff`/`nerf.network.NeRFNetwork`: two small networks without biases."""

    def __init__(self, hidden_dim=64, geo_feat_dim=15, num_layers=2, num_layers_color=3):
        super().__init__()
        self.num_layers, self.num_layers_color = num_layers, num_layers_color
        sizes = [3 + 3 * 2 * 6] + [hidden_dim] * (num_layers - 1) + [1 + geo_feat_dim]
        self.sigma_net = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in itertools.pairwise(sizes))
        sizes = [3 + 3 * 2 * 4 + geo_feat_dim] + [hidden_dim] * (num_layers_color - 1) + [3]
        self.color_net = nn.ModuleList(nn.Linear(i, o, bias=False) for i, o in itertools.pairwise(sizes))

    def density(self, x: Tensor) -> dict[str, Tensor]:
        h = encode(x, 6)
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

    # before
    model = NeRFNetwork()
    sigma, rgb = model(x, d)
    density = model.density(x)

    # after
    model = VoronoiRouter(model, torch.rand(16, 3) * 2 - 1, coords="first3", methods=["density"], fuse=True)
    routed_sigma, routed_rgb = model(x, d)
    routed_density = model.density(x)

    torch.testing.assert_close((routed_sigma, routed_rgb, routed_density), (sigma, rgb, density))
    print(f"torch-ngp: {model.num_cells} cells, sigma {list(routed_sigma.shape)}, rgb {list(routed_rgb.shape)}")


if __name__ == "__main__":
    main()
