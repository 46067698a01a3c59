"""The network of yenchenlin/nerf-pytorch: `NeRF.forward(x)` maps encoded inputs [m, 63 + 27] to raw outputs [m, 4].

The first three columns of the encoding are the raw position, so the router takes `coords="first3"`.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from voronerf import VoronoiRouter


def encode(x: Tensor, octaves: int) -> Tensor:
    """Returns the encoding [..., d (1 + 2 octaves)] of x [..., d]; x itself comes first."""
    waves = [wave(2**i * x) for i in range(octaves) for wave in (torch.sin, torch.cos)]
    return torch.cat([x, *waves], dim=-1)


class NeRF(nn.Module):
    """A stand-in for `run_nerf_helpers.NeRF`."""

    def __init__(self, D=8, W=256, input_ch=3, input_ch_views=3, output_ch=4, skips=(4,), use_viewdirs=False):
        super().__init__()
        self.input_ch, self.input_ch_views = input_ch, input_ch_views
        self.skips, self.use_viewdirs = skips, use_viewdirs
        widths = [input_ch] + [W + input_ch if i in skips else W for i in range(D - 1)]
        self.pts_linears = nn.ModuleList(nn.Linear(width, W) for width in widths)
        self.views_linears = nn.ModuleList([nn.Linear(input_ch_views + W, W // 2)])
        if use_viewdirs:
            self.feature_linear = nn.Linear(W, W)
            self.alpha_linear = nn.Linear(W, 1)
            self.rgb_linear = nn.Linear(W // 2, 3)
        else:
            self.output_linear = nn.Linear(W, output_ch)

    def forward(self, x: Tensor) -> Tensor:
        points, views = torch.split(x, [self.input_ch, self.input_ch_views], dim=-1)
        h = points
        for i, layer in enumerate(self.pts_linears):
            h = F.relu(layer(h))
            if i in self.skips:
                h = torch.cat([points, h], -1)
        if not self.use_viewdirs:
            return self.output_linear(h)
        alpha = self.alpha_linear(h)
        h = torch.cat([self.feature_linear(h), views], -1)
        for layer in self.views_linears:
            h = F.relu(layer(h))
        return torch.cat([self.rgb_linear(h), alpha], -1)


def run_network(inputs: Tensor, viewdirs: Tensor, fn: nn.Module, netchunk: int = 1024) -> Tensor:
    """Encodes points [rays, samples, 3] and calls the network in chunks, like `run_nerf.run_network`."""
    flat = inputs.reshape(-1, 3)
    views = viewdirs[:, None].expand(inputs.shape).reshape(-1, 3)
    embedded = torch.cat([encode(flat, 10), encode(views, 4)], -1)
    raw = torch.cat([fn(part) for part in embedded.split(netchunk)])
    return raw.reshape(*inputs.shape[:-1], -1)


def main() -> None:
    torch.manual_seed(0)
    points = torch.rand(50, 64, 3) * 2 - 1
    viewdirs = F.normalize(torch.randn(50, 3), dim=-1)
    centres = torch.rand(16, 3) * 2 - 1

    # Before: one network.
    model = NeRF(D=8, W=64, input_ch=63, input_ch_views=27, use_viewdirs=True)
    raw = run_network(points, viewdirs, model)

    # After: 16 copies of the model, one per cell; code that calls `model` does not change.
    router = VoronoiRouter(model, centres, coords="first3", fuse=True)
    routed = run_network(points, viewdirs, router)
    torch.testing.assert_close(routed, raw)

    optimizer = torch.optim.Adam(router.parameters(), lr=5e-4)
    for _ in range(3):
        loss = (torch.sigmoid(run_network(points, viewdirs, router)[..., :3]) - 0.5).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()

    # Splits the cells. To resume such a run, build the router and its optimiser, and load both states.
    flat = points.reshape(-1, 3)
    router.subdivide(4, optimizer=optimizer, points=flat, weights=torch.ones(len(flat)), min_samples=100)
    resumed = VoronoiRouter(model, centres[:1], coords="first3", fuse=True)
    again = torch.optim.Adam(resumed.parameters(), lr=5e-4)
    again.load_state_dict(optimizer.state_dict())
    resumed.load_state_dict(router.state_dict())
    torch.testing.assert_close(run_network(points, viewdirs, resumed), run_network(points, viewdirs, router))
    print(f"nerf-pytorch: {router.num_cells} cells, loss {loss.item():.4f} after three steps")


if __name__ == "__main__":
    main()
