"""The network of hjxwhy/mipnerf_pl: `MLP.forward(x, view_direction=None)` returns (rgb, density).

The inputs are [rays, samples, 96] and [rays, 27]. An integrated encoding holds no position, so each call passes the
means of the frustums as `coords=`; without them the router raises an error. The view directions have one row for each
ray, so `per_ray=` names their argument.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


def encode(x: Tensor, octaves: int) -> Tensor:
    """Returns the encoding [..., d (1 + 2 octaves)] of x [..., d]; x itself comes first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


def integrated_encode(means: Tensor, variances: Tensor, octaves: int) -> Tensor:
    """A stand-in for `models.mip.integrated_pos_enc`: encodes means and variances [..., 3] as [..., 6 octaves]."""
    scaled = torch.cat([2**i * means for i in range(octaves)], dim=-1)
    fading = torch.exp(-0.5 * torch.cat([4**i * variances for i in range(octaves)], dim=-1))
    return torch.cat([torch.sin(scaled) * fading, torch.cos(scaled) * fading], dim=-1)


class MLP(nn.Module):
    """A stand-in for `models.mip_nerf.MLP`."""

    def __init__(self, net_depth=8, net_width=256, net_width_condition=128, skip_index=4, xyz_dim=96, view_dim=27):
        super().__init__()
        self.skip_index = skip_index
        layers = []
        for i in range(net_depth):
            skipped = i > 1 and (i - 1) % skip_index == 0
            width = xyz_dim if i == 0 else net_width + (xyz_dim if skipped else 0)
            layers.append(nn.Sequential(nn.Linear(width, net_width), nn.ReLU(True)))
        self.layers = nn.ModuleList(layers)
        self.density_layer = nn.Linear(net_width, 1)
        self.extra_layer = nn.Linear(net_width, net_width)
        self.view_layers = nn.Sequential(nn.Linear(net_width + view_dim, net_width_condition), nn.ReLU(True))
        self.color_layer = nn.Linear(net_width_condition, 3)

    def forward(self, x: Tensor, view_direction: Tensor | None = None) -> tuple[Tensor, Tensor]:
        num_samples, inputs = x.shape[1], x
        for i, layer in enumerate(self.layers):
            x = layer(x)
            if i > 0 and i % self.skip_index == 0:
                x = torch.cat([x, inputs], dim=-1)
        raw_density = self.density_layer(x)
        if view_direction is None:
            return raw_density, x
        view = view_direction[:, None, :].repeat(1, num_samples, 1)
        x = self.view_layers(torch.cat([self.extra_layer(x), view], dim=-1))
        return self.color_layer(x), raw_density


def main() -> None:
    torch.manual_seed(0)
    means, variances = torch.rand(40, 32, 3) * 2 - 1, torch.rand(40, 32, 3) * 1e-3
    samples_enc = integrated_encode(means, variances, 16)
    viewdirs_enc = encode(F.normalize(torch.randn(40, 3), dim=-1), 4)

    # Before: one network.
    mlp = MLP(net_depth=8, net_width=64, net_width_condition=32)
    raw_rgb, raw_density = mlp(samples_enc, viewdirs_enc)

    # After: one network per cell.
    mlp = VoronoiRouter(mlp, torch.rand(16, 3) * 2 - 1, per_ray=["view_direction"], fuse=True)
    routed_rgb, routed_density = mlp(samples_enc, viewdirs_enc, coords=means)

    torch.testing.assert_close(routed_rgb, raw_rgb)
    torch.testing.assert_close(routed_density, raw_density)
    print(f"mipnerf_pl: {mlp.num_cells} cells, {list(routed_rgb.shape)}, {list(routed_density.shape)}")
    try:
        mlp(samples_enc, viewdirs_enc)
    except ValueError as error:
        print(f"without coords: {error}")


if __name__ == "__main__":
    main()
