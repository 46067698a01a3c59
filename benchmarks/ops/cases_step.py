"""Cases of a training step's ops besides networks: pixel_rays, render_loss, observe_occupancy and adam.

b rays of a batch, m samples of all rays; n is the number of rays, samples or entries. Sizes are as in a step on Lego at
100 x 100. All cases run on one thread.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ops.case import BACKWARD, FORWARD, Case, Contender, Work, generator, relative_error, rotation
from voronerf import ops
from voronerf.nerf.cameras import orbit_cameras
from voronerf.ops.formulas import voxels_of

RAYS, SAMPLES = 1 << 10, 1 << 13
"""Rays and samples of a step."""
GRID = 64
"""Cells of the occupancy grid along each axis."""
SCALE = 10.0
"""The factor of the density, the ``density_scale`` of render_loss."""

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
Results = list[Tensor]


def cases() -> list[Case]:
    """Returns the cases of these ops."""
    pixels, losses = functools.partial(pixel_work, RAYS), functools.partial(loss_work, RAYS, SAMPLES)
    observed = functools.partial(observe_work, SAMPLES)
    rows: list[tuple[str, str, str, int, Callable[[torch.device], Work]]] = [
        ("pixel_rays", f"100 views of 100 x 100 b={RAYS}", FORWARD, RAYS, pixels),
        ("render_loss", f"b={RAYS} m={SAMPLES}", BACKWARD, SAMPLES, losses),
        ("observe_occupancy", f"m={SAMPLES} in {GRID}^3 cells", FORWARD, SAMPLES, observed),
    ]
    for log2_entries, touched in ((15, 1.0), (19, 1 / 64)):
        entries = 8 << log2_entries
        name = f"8 x 2^{log2_entries} entries, {touched:.0%} with a gradient"
        rows.append(("adam", name, FORWARD, entries, functools.partial(adam_work, entries, touched)))
    backends = ("native", "reference")
    return [
        Case(op, name, torch.float32, direction, n, None, work, backends, "2^19" not in name, threads=1)
        for op, name, direction, n, work in rows
    ]


def _worst(expected: Results) -> Callable[[Any], float]:
    return lambda found: max(relative_error(a, b) for a, b in zip(found, expected, strict=True))


def pixel_work(b: int, device: torch.device) -> Work:
    """Builds the case of drawing rays and colours of b pixels."""
    draw, side, views = generator(0), 100, 100
    cameras = orbit_cameras(views, radius=4.0, elevation=0.5, width=side, height=side, focal=140.0).to(device)
    images = torch.randint(0, 256, (views, side, side, 4), generator=draw, dtype=torch.uint8).to(device)
    box = torch.tensor(BOX, device=device)
    count = rotation(b * 64)
    sets = [torch.randint(0, views * side * side, (b,), generator=draw).to(device) for _ in range(count)]
    colours = torch.rand(b, 3, generator=draw).to(device)

    def contender(function: Callable[..., Any]) -> Contender:
        options = {"near": 2.0, "far": 6.0, "box": box, "background": colours}
        return Contender(
            lambda call: function(cameras.poses, cameras.intrinsics, images, sets[call % count], **options)
        )

    exact = [x.double() for x in contender(functools.partial(ops.pixel_rays, backend="reference")).run(0)]
    return Work(
        lambda backend: contender(functools.partial(ops.pixel_rays, backend=backend)),
        {"torch, rays by matmul": lambda: contender(_rays_by_matmul)},
        _worst(exact),
        1e-4,
        b * 64.0,  # an index, a colour and eleven floats
        "copy",
    )


def _rays_by_matmul(
    poses: Tensor,
    intrinsics: Tensor,
    images: Tensor,
    index: Tensor,
    *,
    near: float,
    far: float,
    box: Any,
    background: Any,
) -> Results:
    """Draws a batch as other codebases do: gather, directions, a matrix product per ray, box intersection."""
    height, width = images.shape[1:3]
    camera, pixel = index // (height * width), index % (height * width)
    fx, fy, cx, cy = intrinsics[camera].unbind(-1)
    x, y = (pixel % width + 0.5 - cx) / fx, (pixel // width + 0.5 - cy) / fy
    local = torch.stack((x, -y, -torch.ones_like(x)), dim=-1)
    pose = poses[camera]
    directions = F.normalize((pose[:, :3, :3] @ local[:, :, None])[..., 0], dim=-1)
    origins = pose[:, :3, 3]
    slabs = (box[:, None] - origins) / directions
    enter = slabs.amin(0).amax(-1).clamp(near, far)
    leave = torch.maximum(slabs.amax(0).amin(-1).clamp(near, far), enter)
    values = images.view(-1, 4)[index].float() / 255
    return [origins, directions, enter, leave, values[:, :3] * values[:, 3:] + background * (1 - values[:, 3:])]


def loss_work(b: int, m: int, device: torch.device) -> Work:
    """Builds the case of loss and gradient of m samples on b rays of random lengths."""
    draw = generator(0)
    cuts = torch.randint(0, m + 1, (b - 1,), generator=draw).sort().values
    offsets = F.pad(cuts, (1, 1))
    offsets[-1] = m
    offsets = offsets.int().to(device)
    count = rotation(m * 4 * 10)
    sets = [torch.randn(m, 4, generator=draw).to(device) for _ in range(count)]
    deltas = torch.rand(m, generator=draw).to(device) / 16
    target, background = torch.rand(2, b, 3, generator=draw).to(device)

    def contender(results: Callable[..., Results]) -> Contender:
        return Contender(lambda call: results(sets[call % count]))

    def by_ours(raw: Tensor, backend: str = "reference") -> Results:
        lengths, aim, behind = (x.to(raw.dtype) for x in (deltas, target, background))
        options = {"background": behind, "density_scale": SCALE, "backend": backend}
        result = ops.render_loss(raw, lengths, offsets, aim, **options)
        return [result.loss, result.gradient]

    def by_composite(raw: Tensor) -> Results:
        raw = raw.detach().requires_grad_()
        colour, sigma = torch.sigmoid(raw[:, :3]), SCALE * F.softplus(raw[:, 3])
        depths = torch.zeros_like(deltas)
        seen = ops.composite(sigma, colour, depths, deltas, ray_offsets=offsets, background=background).colour
        loss = F.mse_loss(seen, target)
        return [loss.detach(), *torch.autograd.grad(loss, raw)]

    exact = by_ours(sets[0].double())
    return Work(
        lambda backend: contender(functools.partial(by_ours, backend=backend)),
        {"activations, composite, mse_loss": lambda: contender(by_composite)},
        _worst(exact),
        1e-2,
        m * 4.0 * (4 + 4 + 1),
        "copy",
    )


def observe_work(m: int, device: torch.device) -> Work:
    """Builds the case of observe_occupancy for m samples near a sphere."""
    draw = generator(0)
    box = torch.tensor(BOX, device=device)
    count = rotation(m * 24)

    def batch() -> Results:
        shell = F.normalize(torch.randn(m, 3, generator=draw), dim=1) * 0.7
        values = torch.rand(3, m, generator=draw)
        return [x.to(device) for x in (shell, 50 * values[0], values[1] / 32, values[2] / 64)]

    sets = [batch() for _ in range(count)]
    settings = {"decay": 0.8, "threshold": 2.0, "hidden": 1e-3}

    def contender(function: Callable[..., Any]) -> Contender:
        density = torch.rand((GRID,) * 3, generator=generator(1)).to(device) * 4
        occupied = density >= settings["threshold"]

        def run(call: int) -> Results:
            function(density, occupied, box, *sets[call % count], **settings)
            # The check of call 0 reads the densities after later calls have changed them.
            return [density.clone(), occupied.float()] if call == 0 else [density, occupied]

        return Contender(run)

    exact = contender(functools.partial(ops.observe_occupancy, backend="reference")).run(0)
    return Work(
        lambda backend: contender(functools.partial(ops.observe_occupancy, backend=backend)),
        {"torch, as nerfacc": lambda: contender(_observe_all)},
        _worst(exact),
        1e-5,
        m * 24.0,
        "copy",
    )


def _observe_all(
    density: Tensor,
    occupied: Tensor,
    box: Tensor,
    positions: Tensor,
    sigma: Tensor,
    deltas: Tensor,
    weights: Tensor,
    *,
    decay: float,
    threshold: float,
    hidden: float,
) -> None:
    """Updates the cells of the samples, then thresholds all cells, as nerfacc's ``OccGridEstimator`` does."""
    rows = voxels_of(positions, box, density.shape).long()
    seen = weights > hidden * (1 - torch.exp(-sigma * deltas))
    flat = density.view(-1)
    flat[rows] = flat[rows] * decay
    flat.scatter_reduce_(0, rows, torch.where(seen, sigma, 0), "amax")
    occupied.copy_(density >= threshold)


def adam_work(entries: int, touched: float, device: torch.device) -> Work:
    """Builds the case of a table of ``entries`` x 2 features; a fraction ``touched`` of the entries has gradients."""
    draw = generator(0)
    table = torch.randn(entries, 2, generator=draw).to(device)
    present = torch.rand(entries, 1, generator=draw) < touched
    gradient = (torch.randn(entries, 2, generator=draw) * present).to(device)

    def ours(backend: str) -> Contender:
        state = [table.clone(), torch.zeros_like(table), torch.zeros_like(table)]
        rule = ops.UpdateRule(torch.zeros((), device=device), 1e-2, dense=False)

        def run(call: int) -> Results:
            lists = ([tensor] for tensor in (state[0], gradient, *state[1:]))
            ops.adam([rule], *lists, backend=backend)
            return state[:1]

        return Contender(run)

    def torchs() -> Contender:
        parameter = torch.nn.Parameter(table.clone())
        parameter.grad = gradient
        optimizer = torch.optim.Adam([parameter], lr=1e-2, fused=True)

        def run(call: int) -> Results:
            optimizer.step()
            return [parameter.detach()]

        return Contender(run)

    exact = [x.clone() for x in ours("reference").run(0)]
    return Work(
        ours,
        {"torch.optim.Adam, fused": torchs},
        _worst(exact),
        1e-5,
        # Reads the gradient; reads and writes the parameters and two moments of the touched entries.
        gradient.nbytes * (1 + 6 * touched),
        "copy",
    )
