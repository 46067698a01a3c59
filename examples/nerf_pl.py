"""The network of kwea123/nerf_pl: `NeRF.forward(x, sigma_only=False)` maps [m, 63 + 27] to [m, 4].

With `sigma_only`, it maps [m, 63] to densities [m, 1]. So the flag changes both the input and the layers that run; the
router passes it on. The layers are attributes that are looked up by name.
"""

import torch
from torch import Tensor, nn

from voronerf import VoronoiRouter


def encode(x: Tensor, octaves: int) -> Tensor:
    """Returns the encoding [..., d (1 + 2 octaves)] of x [..., d]; x itself comes first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


class NeRF(nn.Module):
    """A stand-in for `models.nerf.NeRF`."""

    def __init__(self, D=8, W=256, in_channels_xyz=63, in_channels_dir=27, skips=(4,)):
        super().__init__()
        self.D, self.skips = D, skips
        self.in_channels_xyz, self.in_channels_dir = in_channels_xyz, in_channels_dir
        for i in range(D):
            width = in_channels_xyz if i == 0 else W + (in_channels_xyz if i in skips else 0)
            setattr(self, f"xyz_encoding_{i + 1}", nn.Sequential(nn.Linear(width, W), nn.ReLU(True)))
        self.xyz_encoding_final = nn.Linear(W, W)
        self.dir_encoding = nn.Sequential(nn.Linear(W + in_channels_dir, W // 2), nn.ReLU(True))
        self.sigma = nn.Linear(W, 1)
        self.rgb = nn.Sequential(nn.Linear(W // 2, 3), nn.Sigmoid())

    def forward(self, x: Tensor, sigma_only: bool = False) -> Tensor:
        if sigma_only:
            xyz, direction = x, None
        else:
            xyz, direction = torch.split(x, [self.in_channels_xyz, self.in_channels_dir], dim=-1)
        h = xyz
        for i in range(self.D):
            if i in self.skips:
                h = torch.cat([xyz, h], -1)
            h = getattr(self, f"xyz_encoding_{i + 1}")(h)
        sigma = self.sigma(h)
        if sigma_only:
            return sigma
        h = self.dir_encoding(torch.cat([self.xyz_encoding_final(h), direction], -1))
        return torch.cat([self.rgb(h), sigma], -1)


def main() -> None:
    torch.manual_seed(0)
    points, directions = torch.rand(2000, 3) * 2 - 1, torch.randn(2000, 3)
    xyz = encode(points, 10)
    x = torch.cat([xyz, encode(directions, 4)], -1)

    # Before: one network.
    nerf = NeRF(D=8, W=64)
    out, sigma = nerf(x), nerf(xyz, sigma_only=True)

    # After: one network per cell.
    nerf = VoronoiRouter(nerf, torch.rand(16, 3) * 2 - 1, coords="first3", fuse=True)
    routed, routed_sigma = nerf(x), nerf(xyz, sigma_only=True)

    torch.testing.assert_close(routed, out)
    torch.testing.assert_close(routed_sigma, sigma)
    print(f"nerf_pl: {nerf.num_cells} cells, {list(routed.shape)}, densities alone {list(routed_sigma.shape)}")


if __name__ == "__main__":
    main()
