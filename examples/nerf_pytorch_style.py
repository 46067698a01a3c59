"""A training loop in the style of nerf-pytorch, with three lines that add Voronoi cells.

    python examples/nerf_pytorch_style.py SCENE --downscale 4 --seconds 480                          # width 256
    python examples/nerf_pytorch_style.py SCENE --downscale 4 --seconds 480 --width 64
    python examples/nerf_pytorch_style.py SCENE --downscale 4 --seconds 480 --width 64 --voronoi

`--voronoi` enables the lines marked `changed`; everything else stays the same, also the learning rate and its schedule.
`--seconds` counts training only, not evaluation. As in the original, the encoding is outside the network, samples are
stratified, and compositing is plain PyTorch. The density is a softplus (mip-NeRF), which suits short runs.
"""

import argparse
import time

import torch
import torch.nn.functional as F
from nerf_pytorch import NeRF, run_network
from torch import Tensor, nn

from voronerf import SampleReservoir, VoronoiRouter
from voronerf.app.scenes import load_scene


def render(model: nn.Module, rays: Tensor, near: float, far: float, samples: int, jitter: bool) -> tuple[Tensor, ...]:
    """Renders rays [r, 6] on a white background; returns colours [r, 3], points [r, s, 3] and their weights [r, s]."""
    origins, directions = rays[:, :3], rays[:, 3:]
    strata = torch.arange(samples) + (torch.rand(len(rays), samples) if jitter else 0.5)
    depths = (near + (far - near) / samples * strata).expand(len(rays), samples)
    points = origins[:, None] + depths[..., None] * directions[:, None]
    raw = run_network(points, directions, model, netchunk=1 << 17)
    alpha = 1 - torch.exp(-F.softplus(raw[..., 3] - 1) * (far - near) / samples)
    through = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-10], -1), -1)[:, :-1]
    weights = alpha * through
    colour = (weights[..., None] * torch.sigmoid(raw[..., :3])).sum(1) + (1 - weights.sum(1, keepdim=True))
    return colour, points, weights


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", help="a folder that voronerf.app.scenes.load_scene reads, or 'builtin'")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=120, help="of training")
    parser.add_argument("--width", type=int, default=256, help="channels of the network's hidden layers")
    parser.add_argument("--depth", type=int, default=8, help="hidden layers")
    parser.add_argument("--rays", type=int, default=1024, help="in a batch")
    parser.add_argument("--samples", type=int, default=64, help="of a ray")
    parser.add_argument("--lr", type=float, default=2e-3)
    parser.add_argument("--views", type=int, default=5, help="test views that are rendered, at the most")
    parser.add_argument("--voronoi", action="store_true", help="16 cells, split after a fifth of the seconds")
    options = parser.parse_args()

    torch.manual_seed(0)
    scene = load_scene(options.scene, downscale=options.downscale)

    def view(split, i: int) -> Tensor:
        rays = split.cameras.image_rays(i)
        return torch.cat([rays.origins, rays.directions, split.truth(i, torch.ones(3)).reshape(-1, 3)], -1)

    pixels = torch.cat([view(scene.train, i) for i in range(len(scene.train))])
    model = NeRF(options.depth, options.width, input_ch=63, input_ch_views=27, use_viewdirs=True)
    if options.voronoi:
        model, kept = VoronoiRouter(model, torch.zeros(1, 3), coords="first3", fuse=True), SampleReservoir()  # changed
    optimizer = torch.optim.Adam(model.parameters(), lr=options.lr)

    began, step, spent = time.perf_counter(), 0, 0.0
    while spent < options.seconds:
        batch = pixels[torch.randint(len(pixels), (options.rays,))]
        colour, points, weights = render(model, batch[:, :6], scene.near, scene.far, options.samples, jitter=True)
        error = (colour - batch[:, 6:]).square()
        optimizer.zero_grad()
        error.mean().backward()
        optimizer.step()
        if options.voronoi:
            kept.add(points, weights * error.sum(-1, keepdim=True))  # changed
            if model.num_cells == 1 and spent > 0.2 * options.seconds:
                model.subdivide(16, optimizer=optimizer, points=kept.samples()[0], weights=kept.samples()[1])  # changed
        step, spent = step + 1, time.perf_counter() - began
        optimizer.param_groups[0]["lr"] = options.lr * 0.1 ** min(spent / options.seconds, 1)
        if step % 100 == 0:
            print(f"step {step}, {spent:.0f} s, {-10 * error.mean().log10():.2f} dB in the batch", flush=True)

    scores = []
    with torch.no_grad():
        for i in range(0, len(scene.test), -(-len(scene.test) // options.views)):
            errors = []
            for part in view(scene.test, i).split(4096):
                colour = render(model, part[:, :6], scene.near, scene.far, options.samples, jitter=False)[0]
                errors.append((colour - part[:, 6:]).square().mean(-1))
            scores.append(-10 * torch.cat(errors).mean().log10())
    psnr = torch.stack(scores).mean()
    cells = f"{model.num_cells} cells" if options.voronoi else "one network"
    print(f"{cells} of width {options.width}: {step} steps in {spent:.0f} s, test PSNR {psnr:.2f} dB")


if __name__ == "__main__":
    main()
