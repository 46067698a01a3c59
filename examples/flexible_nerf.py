"""The network of krrish94/nerf-pytorch: `FlexibleNeRFModel.forward(x)` maps encoded inputs [..., 66] to [..., 4].

The first 39 columns encode the position, the other 27 the direction. Any leading dimensions work, so rays and samples
need not be flattened: [rays, samples, 66] becomes [rays, samples, 4].
"""

import torch
from torch import Tensor, nn

from voronerf import VoronoiRouter


def encode(x: Tensor, octaves: int) -> Tensor:
    """Returns the encoding [..., d (1 + 2 octaves)] of x [..., d]; x itself comes first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


class FlexibleNeRFModel(nn.Module):
    """A stand-in for `nerf.models.FlexibleNeRFModel`, which has no activation between its first two layers."""

    def __init__(
        self, num_layers=4, hidden_size=128, skip_connect_every=4, num_encoding_fn_xyz=6, num_encoding_fn_dir=4
    ):
        super().__init__()
        self.dim_xyz, self.dim_dir = 3 + 6 * num_encoding_fn_xyz, 3 + 6 * num_encoding_fn_dir
        self.layer1 = nn.Linear(self.dim_xyz, hidden_size)
        self.skips = [i for i in range(1, num_layers - 1) if i % skip_connect_every == 0]
        self.layers_xyz = nn.ModuleList(
            nn.Linear(hidden_size + (self.dim_xyz if i in self.skips else 0), hidden_size)
            for i in range(num_layers - 1)
        )
        self.layers_dir = nn.ModuleList([nn.Linear(self.dim_dir + hidden_size, hidden_size // 2)])
        self.fc_alpha = nn.Linear(hidden_size, 1)
        self.fc_rgb = nn.Linear(hidden_size // 2, 3)
        self.fc_feat = nn.Linear(hidden_size, hidden_size)
        self.relu = torch.nn.functional.relu

    def forward(self, x: Tensor) -> Tensor:
        xyz, view = x[..., : self.dim_xyz], x[..., self.dim_xyz :]
        x = self.layer1(xyz)
        for i, layer in enumerate(self.layers_xyz):
            if i in self.skips:
                x = torch.cat((x, xyz), dim=-1)
            x = self.relu(layer(x))
        feat, alpha = self.relu(self.fc_feat(x)), self.fc_alpha(x)
        x = torch.cat((feat, view), dim=-1)
        for layer in self.layers_dir:
            x = self.relu(layer(x))
        return torch.cat((self.fc_rgb(x), alpha), dim=-1)


def main() -> None:
    torch.manual_seed(0)
    points, views = torch.rand(40, 32, 3) * 2 - 1, torch.randn(40, 1, 3).expand(40, 32, 3)
    x = torch.cat([encode(points, 6), encode(views, 4)], -1)

    # Before: one network.
    model = FlexibleNeRFModel(num_layers=6, hidden_size=64)
    radiance_field = model(x)

    # After: one network per cell.
    model = VoronoiRouter(model, torch.rand(16, 3) * 2 - 1, coords="first3", fuse=True)
    routed = model(x)

    torch.testing.assert_close(routed, radiance_field)
    print(f"FlexibleNeRFModel: {model.num_cells} cells, {list(x.shape)} -> {list(routed.shape)}")


if __name__ == "__main__":
    main()
