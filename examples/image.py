"""Fits an image with one SIREN per cell, or with one large SIREN (as in COIN), and prints the PSNR after a given time.

python examples/image.py PHOTO.jpg --seconds 40             # 16 cells of width 32
python examples/image.py PHOTO.jpg --seconds 40 --one       # one network of width 128
"""

from __future__ import annotations

import argparse
import itertools
import math
import time

import numpy as np
import torch
from PIL import Image
from torch import Tensor, nn

from voronerf import VoronoiDiagram, VoronoiRouter


class Siren(nn.Module):
    """A SIREN from 2 coordinates to an RGB colour (Sitzmann et al. 2020), as in EmilienDupont/coin."""

    def __init__(self, width: int, depth: int = 6, w0: float = 30.0) -> None:
        super().__init__()
        self.w0, sizes = w0, [2, *[width] * depth, 3]
        self.layers = nn.ModuleList([nn.Linear(a, b) for a, b in itertools.pairwise(sizes)])
        for i, layer in enumerate(self.layers):
            bound = 1 / layer.in_features if i == 0 else math.sqrt(6 / layer.in_features) / w0
            nn.init.uniform_(layer.weight, -bound, bound)
            nn.init.uniform_(layer.bias, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers[:-1]:
            x = torch.sin(self.w0 * layer(x))
        return self.layers[-1](x)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("image", nargs="?", help="a drawing of 256 x 256 if left out")
    parser.add_argument("--seconds", type=float, default=1.0, help="of processor time")
    parser.add_argument("--one", action="store_true", help="one network of width 128")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    if options.image:
        colours = torch.from_numpy(np.array(Image.open(options.image).convert("RGB"))) / 255
    else:
        rows = torch.linspace(0, 1, 256)
        colours = torch.stack([rows[:, None] * rows, (40 * rows.outer(rows)).sin().abs(), rows.outer(1 - rows)], -1)
    h, w, _ = colours.shape
    axes = torch.linspace(-1, 1, h), torch.linspace(-w / h, w / h, w)  # square pixels, so cells are round
    x, y = torch.cartesian_prod(*axes), colours.reshape(-1, 3)

    # These four lines add the cells.
    net: nn.Module = Siren(128)
    if not options.one:
        diagram = VoronoiDiagram.from_points(x, 16)
        net = VoronoiRouter(Siren(32), diagram, coords="first2", fuse=True)

    optimizer = torch.optim.Adam(net.parameters(), lr=5e-4)
    began, steps = time.process_time(), 0
    while time.process_time() - began < options.seconds:
        batch = torch.randint(len(x), (16384,))
        loss = (net(x[batch]) - y[batch]).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        steps += 1
    with torch.no_grad():
        error = torch.cat([(net(a).clamp(0, 1) - b).square() for a, b in zip(x.split(65536), y.split(65536))]).mean()
    name = "one network" if options.one else "16 cells"
    print(f"{name}: {-10 * error.log10():.2f} dB of {len(x) / 1e6:.2f} megapixels after {steps} steps")


if __name__ == "__main__":
    main()
