"""Measures held-out views of a run: how clean silhouettes are, how smooth depth is in plain patches, and holes.

    python benchmarks/edges.py RUN

- half: the fraction of half-covered pixels among the pixels within 8 pixels of a silhouette. At a silhouette, the
  disparity changes by more than a tenth from pixel to pixel. This disparity is the inverse of the depth at which a ray
  has half of its opacity, median-filtered over 5 x 5 pixels. The coverage of a pixel is the sum of the rendering
  weights of its samples in front of the geometric mean of the nearest and farthest depths around the pixel. A pixel
  with a coverage of 0.1 to 0.9 is half covered.
- rough: the root mean square distance of disparities (here the inverse mean depths) from a fitted plane in patches of
  9 x 9 pixels, in percent of the mean disparity. It is averaged over plain patches, which are away from silhouettes and
  have a standard deviation of grey values below 0.015.
- holes: the percentage of pixels with an opacity below one half.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d, pad, unfold

from voronerf.app import open_run
from voronerf.app.scenes import Scene
from voronerf.nerf import Occupancy, Renderer
from voronerf.ops import composite

BESIDE, CHANGE, CLEAR, PATCH, STRIDE, PLAIN, CHUNK = 8, 1.1, 0.1, 9, 5, 0.015, 16_384


class Looked(NamedTuple):
    """A rendered view and its samples.

    Attributes:
        opacity: The opacity of each ray [h, w].
        mean: The mean depth of each ray's samples, weighted by the rendering weights [h, w].
        half: The depth at which each ray has half of its opacity [h, w].
        samples: A tuple for each chunk of rays: the ray (counted within the chunk), depth and rendering weight of each
            sample, and the number of rays.
    """

    opacity: Tensor
    mean: Tensor
    half: Tensor
    samples: list[tuple[Tensor, Tensor, Tensor, int]]

    def before(self, depth: Tensor) -> Tensor:
        """Returns the sum [h, w] of the rendering weights of the samples in front of the depths [h, w]."""
        parts, begin, ends = [], 0, depth.reshape(-1)
        for ray, depths, weights, rays in self.samples:
            near = torch.where(depths < ends[begin : begin + rays][ray], weights, 0)
            parts.append(torch.zeros(rays).index_add(0, ray, near))
            begin += rays
        return torch.cat(parts).view(depth.shape)


@torch.no_grad()
def look(renderer: Renderer, scene: Scene, index: int) -> Looked:
    """Renders a held-out view with all samples of its rays."""
    cameras, sampler = scene.test.cameras, renderer.train(False).sampler
    assert isinstance(sampler, Occupancy)
    rays, near, far = cameras.image_rays_between(index, near=scene.near, far=scene.far, box=scene.box)
    parts, kept = [], []
    for begin in range(0, len(near), CHUNK):
        rows = slice(begin, begin + CHUNK)
        samples, _ = sampler.march(rays[rows], near[rows], far[rows], picture=True)
        rgb, density = renderer.field(samples.inputs, rays[rows].directions, samples.ray_index)
        seen = composite(density, rgb, samples.depths, samples.deltas, ray_offsets=samples.ray_offsets)
        ray, sums = samples.ray_index.long(), pad(seen.weights.double().cumsum(0), (1, 0))
        past = sums[1:] - sums[samples.ray_offsets[:-1].long()][ray] >= 0.5 * seen.opacity[ray]
        half = near.new_full((len(seen.opacity),), scene.far)
        half.scatter_reduce_(0, ray, torch.where(past, samples.depths, scene.far), "amin")
        parts.append((seen.opacity, seen.depth / seen.opacity.clamp_min(1e-6), half))
        kept.append((ray, samples.depths, seen.weights, len(half)))
    width, height = cameras.size(index)
    return Looked(*(torch.cat(each).view(height, width) for each in zip(*parts, strict=True)), kept)


def highest(values: Tensor, size: int) -> Tensor:
    """Returns the largest of the values [h, w] in a square around each pixel."""
    return max_pool2d(values[None, None], size, 1, size // 2)[0, 0]


def patches(values: Tensor) -> Tensor:
    """Returns the patches [81, n] of values [h, w]."""
    return unfold(values[None, None], PATCH, stride=STRIDE)[0]


def measure(seen: Looked, truth: Tensor) -> dict[str, float]:
    """Returns the three figures of a view, given its photograph [h, w, 3]; NaN without silhouettes or plain patches."""
    around = unfold(pad(seen.half.reciprocal()[None, None], (2, 2, 2, 2), mode="replicate"), 5)[0]
    disparity = around.median(0).values.view(seen.half.shape)
    silhouette = highest(disparity, 3) > -CHANGE * highest(-disparity, 3)
    beside = highest(silhouette.float(), 2 * BESIDE + 1) > 0
    most, least = highest(disparity, 2 * BESIDE + 1), -highest(-disparity, 2 * BESIDE + 1)
    covered = seen.before((most * least).rsqrt())
    half = (covered > CLEAR) & (covered < 1 - CLEAR) & beside
    chosen = (patches(truth.mean(-1)).std(0) < PLAIN) & (patches(beside.float()).amax(0) == 0)
    y, x = torch.meshgrid(*[torch.arange(PATCH) - PATCH // 2] * 2, indexing="ij")
    plane = torch.stack((torch.ones(PATCH**2), x.reshape(-1), y.reshape(-1)), 1)
    disparities = patches(seen.mean.reciprocal())[:, chosen & (patches(seen.opacity).amin(0) > 0)]
    bent = disparities - plane @ (torch.linalg.pinv(plane) @ disparities)
    return {
        "half": float(half.sum() / beside.sum()),
        "rough": 100 * float((bent.square().mean(0).sqrt() / disparities.mean(0)).mean()),
        "holes": 100 * float((seen.opacity < 0.5).float().mean()),
    }


def measure_views(renderer: Renderer, scene: Scene) -> dict[str, Any]:
    """Returns the mean of each figure over the held-out views in which it is finite."""
    views = range(len(scene.test.names))
    rows = [measure(look(renderer, scene, view), scene.test.truth(view, None)) for view in views]
    columns = {name: torch.tensor([figures[name] for figures in rows]) for name in rows[0]}
    return {name: float(values[values.isfinite()].mean()) for name, values in columns.items()}


def main() -> None:
    """Prints the figures of a run as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    run = open_run(parser.parse_args().run)
    print(json.dumps(measure_views(run.renderer, run.scene)))


if __name__ == "__main__":
    main()
