"""Cases of march_rays, camera_rays and balance_centres.

r rays, s strata of a ray, n strata of all rays, cells, pixels or samples; k centres.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ops.case import FORWARD, Case, Contender, NotApplicable, Work, generator, optional, relative_error, rotation
from ops.cases_lookup import FLOPS
from voronerf import ops
from voronerf.ops.camera_rays.reference import camera_rays as reference_camera_rays
from voronerf.rendering.cameras import look_at

FULL = torch.float32
ALL = ("native", "reference", "warp")
STRATA = 64
"""Of a ray."""
GRID = 64
"""Cells of the grid that is marched through, along each axis."""
STEPS = 500
"""Of a balance."""
"""Heaviest samples of a batch: 10,000 over 500 batches."""
LENS = (-0.08, 0.02, 1e-3, -5e-4, 0.0, 0.0, 0.0, 0.0)
"""A lens that bends the corner of a picture by some ten pixels."""


def cases() -> list[Case]:
    """The rows of these ops."""
    found = []
    for n, jitter in ((1 << 18, False), (1 << 18, True), (1 << 22, False)):
        name = f"{'jittered' if jitter else 'middles'} {GRID}^3 n={n}"
        base = n == 1 << 18
        work = functools.partial(_march_work, n, jitter)
        shown = ALL if base else ("native",)
        found.append(Case("march_rays", name, FULL, FORWARD, n, None, work, shown, base and not jitter))
    for n, bent in ((1 << 10, False), (1 << 18, False), (1 << 18, True)):
        base = n == 1 << 18
        work = functools.partial(_camera_work, n, bent)
        name = f"{'lens' if bent else 'pinhole'} n={n}"
        found.append(Case("camera_rays", name, FULL, FORWARD, n, None, work, ("reference", "warp"), base))
    for n, k in ((10_000, 16), (10_000, 256)):
        work = functools.partial(_balance_work, n, k)
        name = f"n={n} k={k} {STEPS} steps"
        found.append(Case("balance_centres", name, FULL, FORWARD, n, k, work, ALL if k == 16 else ("native",), k == 16))
    return found


def _march_work(n: int, jitter: bool, device: torch.device) -> Work:
    rays = n // STRATA
    box = torch.tensor(((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)))
    occupied = _shell().to(device)
    box = box.to(device)

    def batch(seed: int) -> tuple[list[Tensor], Tensor | None]:
        random = generator(seed)
        origins = 4 * F.normalize(torch.randn(rays, 3, generator=random), dim=1)
        directions = F.normalize(torch.rand(rays, 3, generator=random) - 0.5 - origins, dim=1)
        near, far = (torch.full((rays,), value) for value in (2.9, 5.1))
        uniforms = torch.rand(rays, STRATA, generator=random).to(device) if jitter else None
        return [tensor.to(device) for tensor in (origins, directions, near, far)], uniforms

    sets = [batch(seed) for seed in range(rotation(32 * rays + (4 * n if jitter else 0)))]
    exact = ops.march_rays(*sets[0][0], occupied, box, STRATA, uniforms=sets[0][1], backend="reference")

    def contender(function: Callable[..., Any]) -> Contender:
        def run(call: int) -> Any:
            tensors, uniforms = sets[call % len(sets)]
            return function(*tensors, occupied, box, STRATA, uniforms=uniforms)

        return Contender(run)

    def error(found: Any) -> float:
        """Error of the depths against float64; if other strata are kept, the share of rays with a different number."""
        others = float((found[0].diff() != exact.ray_offsets.diff()).double().mean())
        if found[1].shape != exact.ray_index.shape or not torch.equal(found[1], exact.ray_index):
            return others or float("inf")  # the numbers are right, but the samples belong to other rays
        return relative_error(found[2], _exact_depths(*sets[0], exact))

    # Read the rays (and the places in the strata), look up a byte for each stratum, write what is kept.
    amount = 32.0 * rays + n * (5.0 if jitter else 1.0) + 24.0 * exact.ray_index.shape[0] + 8.0 * rays
    return Work(
        lambda backend: contender(functools.partial(ops.march_rays, backend=backend)),
        {"torch, all strata and a mask": lambda: contender(_march_masked)},
        error,
        0.01,  # with another rounding, a sample at the border of a cell falls on the other side
        amount,
        "copy",
    )


def _shell() -> Tensor:
    """A grid in which a thick sphere is occupied, about a tenth of the cells."""
    middles = (torch.arange(GRID) + 0.5) / GRID * 2 - 1
    x, y, z = torch.meshgrid(middles, middles, middles, indexing="ij")
    return ((x * x + y * y + z * z).sqrt() - 0.7).abs() < 0.07


def _exact_depths(rays: list[Tensor], uniforms: Tensor | None, found: Any) -> Tensor:
    """Float64 depths of the samples that are kept."""
    near, far = (rays[i].double()[found.ray_index.long()] for i in (2, 3))
    # The stratum is where the sample lies; an ulp of its depth moves none across a border of its stratum's inside.
    share = (found.depths.double() - near) / (far - near) * STRATA
    stratum = (share - 0.5).round() if uniforms is None else share.floor().clamp(0, STRATA - 1)
    inside = 0.5 if uniforms is None else uniforms[found.ray_index.long(), stratum.long()].double()
    return near + (far - near) * (stratum + inside) / STRATA


def _march_masked(
    origins: Tensor,
    directions: Tensor,
    near: Tensor,
    far: Tensor,
    occupied: Tensor,
    box: Tensor,
    samples: int,
    *,
    uniforms: Tensor | None,
) -> tuple[Tensor, ...]:
    """The place and cell of every sample, and the occupied rows: the code that one writes without the op."""
    r, size = origins.shape[0], occupied.shape[0]
    stratum = torch.arange(samples, device=near.device)
    at = (stratum + (0.5 if uniforms is None else uniforms)) / samples
    length = (far - near)[:, None]
    depths = near[:, None] + length * at
    positions = torch.addcmul(origins[:, None], depths[..., None], directions[:, None])
    place = (positions - box[0]) / (box[1] - box[0]) * size
    inside = ((place >= 0) & (place <= size)).all(-1)
    x, y, z = place.long().clamp_(0, size - 1).unbind(-1)
    kept = inside & occupied.reshape(-1)[(x * size + y) * size + z]
    offsets = F.pad(kept.sum(1).cumsum(0), (1, 0)).int()
    ray = torch.arange(r, device=near.device, dtype=torch.int32)[:, None].expand(r, samples)[kept]
    return offsets, ray, depths[kept], (length / samples).expand(r, samples)[kept], positions[kept]


def _camera_work(n: int, bent: bool, device: torch.device) -> Work:
    count, side = 100, 400
    around = F.normalize(torch.randn(count, 3, generator=generator(1)), dim=1)
    poses = look_at(4 * around, torch.zeros(3), torch.tensor((0.0, 0.0, 1.0))).to(device)
    intrinsics = torch.tensor((555.0, 550.0, side / 2, side / 2)).repeat(count, 1).to(device)
    distortion = torch.tensor(LENS).repeat(count, 1).to(device) if bent else None

    def batch(seed: int) -> list[Tensor]:
        random = generator(seed)
        places = torch.rand(2, n, generator=random) * side
        return [tensor.to(device) for tensor in (*places, torch.randint(0, count, (n,), generator=random).int())]

    sets = [batch(seed) for seed in range(rotation(12 * n))]

    def contender(function: Callable[..., Any]) -> Contender:
        def run(call: int) -> Any:
            x, y, camera = sets[call % len(sets)]
            return function(poses, intrinsics, x, y, camera=camera, distortion=distortion)

        return Contender(run)

    x, y, camera = sets[0]
    wide = [tensor.double() for tensor in (poses, intrinsics, x, y)]
    lens = None if distortion is None else distortion.double()
    exact = reference_camera_rays(*wide, camera=camera, distortion=lens, models=None)
    alternative = "torch, Newton in float32" if bent else "torch, gathered poses + einsum"
    return Work(
        lambda backend: contender(functools.partial(ops.camera_rays, backend=backend)),
        {alternative: lambda: contender(_camera_torch)},
        lambda found: max(relative_error(a, b) for a, b in zip(found, exact)),
        1e-4,
        36.0 * n,
        "copy",
    )


def _camera_torch(
    poses: Tensor, intrinsics: Tensor, x: Tensor, y: Tensor, *, camera: Tensor, distortion: Tensor | None
) -> tuple[Tensor, Tensor]:
    """As nerf-pytorch's get_rays for any pixels of any cameras; the lens as nerfstudio undoes it, ten steps."""
    fx, fy, cx, cy = intrinsics[camera].unbind(-1)
    u, v = (x - cx) / fx, (y - cy) / fy
    if distortion is not None:
        k1, k2, p1, p2 = distortion[camera, :4].unbind(-1)
        a, b = u, v
        for _ in range(10):
            r2 = a * a + b * b
            radial, slope = 1 + r2 * (k1 + r2 * k2), 2 * k1 + 4 * r2 * k2
            fa = radial * a + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) - u
            fb = radial * b + 2 * p2 * a * b + p1 * (r2 + 2 * b * b) - v
            aa = radial + slope * a * a + 2 * p1 * b + 6 * p2 * a
            ab = slope * a * b + 2 * p1 * a + 2 * p2 * b
            bb = radial + slope * b * b + 2 * p2 * a + 6 * p1 * b
            determinant = aa * bb - ab * ab
            a, b = a - (fa * bb - fb * ab) / determinant, b - (fb * aa - fa * ab) / determinant
        u, v = a, b
    pose = poses[camera]
    local = torch.stack((u, -v, -torch.ones_like(u)), -1)
    return pose[:, :3, 3], F.normalize(torch.einsum("nij,nj->ni", pose[:, :3, :3], local), dim=-1)


def _balance_work(n: int, k: int, device: torch.device) -> Work:
    def batch(seed: int) -> list[Tensor]:
        random = generator(seed)
        # Clumps of unequal weight, as importance along surfaces is.
        middles, chosen = torch.randn(40, 3, generator=random), torch.randint(0, 40, (n,), generator=random)
        samples = middles[chosen] + 0.2 * torch.randn(n, 3, generator=random)
        masses = torch.rand(n, generator=random, dtype=torch.float64) ** 4
        return [tensor.to(device) for tensor in (samples, masses, samples[torch.randperm(n, generator=random)[:k]])]

    sets = [batch(seed) for seed in range(4)]
    before = _spread_of_masses(sets[0], sets[0][2])

    def contender(function: Callable[..., Any]) -> Contender:
        return Contender(lambda call: function(*sets[call % len(sets)]))

    def error(found: Any) -> float:
        """The remaining imbalance, relative to the one before; values differ because 500 steps amplify rounding."""
        return _spread_of_masses(sets[0], found[0]) / before

    def tree() -> Contender:
        kd = optional("scipy.spatial").cKDTree
        if device.type != "cpu":
            raise NotApplicable("runs on the CPU")

        def masses(samples: Tensor, weights: Tensor, centres: Tensor) -> Tensor:
            cells = torch.from_numpy(kd(centres.numpy()).query(samples.numpy(), workers=torch.get_num_threads())[1])
            return torch.bincount(cells, weights, minlength=k)

        return contender(functools.partial(_balance_torch, masses))

    return Work(
        lambda backend: contender(functools.partial(ops.balance_centres, steps=STEPS, backend=backend)),
        {
            "torch, cdist": lambda: contender(functools.partial(_balance_torch, _masses_cdist)),
            "torch + scipy cKDTree": tree,
        },
        error,
        0.5,
        float(FLOPS) * n * k * (STEPS + 1),
        "float32",
    )


def _masses_cdist(samples: Tensor, masses: Tensor, centres: Tensor) -> Tensor:
    cells = torch.cdist(samples, centres, compute_mode="donot_use_mm_for_euclid_dist").argmin(1)
    return torch.bincount(cells, masses, minlength=centres.shape[0])


def _balance_torch(
    find: Callable[[Tensor, Tensor, Tensor], Tensor], samples: Tensor, masses: Tensor, centres: Tensor
) -> tuple[Tensor, Tensor]:
    """The published update in a Python loop, `find` giving the mass in each cell."""
    for _ in range(STEPS):
        weights = find(samples, masses, centres)
        others = torch.cdist(centres, centres).topk(min(9, centres.shape[0]), largest=False).indices[:, 1:]
        heaviest = torch.maximum(weights[others].amax(1), weights)[:, None]
        pull = ((weights[others] - weights[:, None]) / heaviest.clamp(min=1e-30)).to(centres.dtype)
        centres = centres + 0.05 * ((centres[others] - centres[:, None]) * pull[..., None]).mean(1)
    return centres, find(samples, masses, centres)


def _spread_of_masses(batch: list[Tensor], centres: Tensor) -> float:
    """std(W / max W) over the cells."""
    weights = _masses_cdist(batch[0].double(), batch[1], centres.double())
    return float((weights / weights.max()).std())
