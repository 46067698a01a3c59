"""Cases of march_rays and balance_centres.

r rays, s strata of a ray, k centres. n is the number of strata of all rays in march_rays, and the number of samples in
balance_centres.
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

FULL = torch.float32
ALL = ("native", "reference", "warp")
STRATA = 64
"""Strata of a ray."""
GRID = 64
"""Cells of the marched grid along each axis."""
STEPS = 500
"""Balancing steps."""


def cases() -> list[Case]:
    """Returns the cases of these ops."""
    rows = []
    for n, jitter in ((1 << 18, False), (1 << 18, True), (1 << 22, False)):
        name = f"{'jittered' if jitter else 'middles'} {GRID}^3 n={n}"
        base = n == 1 << 18
        work = functools.partial(_march_work, n, jitter)
        shown = ALL if base else ("native",)
        rows.append(Case("march_rays", name, FULL, FORWARD, n, None, work, shown, base and not jitter))
    for n, k in ((10_000, 16), (10_000, 256)):
        work = functools.partial(_balance_work, n, k)
        name = f"n={n} k={k} {STEPS} steps"
        rows.append(
            Case(
                "balance_centres",
                name,
                FULL,
                FORWARD,
                n,
                k,
                work,
                ("native", "reference") if k == 16 else ("native",),
                k == 16,
            )
        )
    return rows


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
        """Returns the error of the depths against float64, or the fraction of rays whose number of samples differs."""
        others = float((found[0].diff() != exact.ray_offsets.diff()).double().mean())
        if found[1].shape != exact.ray_index.shape or not torch.equal(found[1], exact.ray_index):
            return others or float("inf")  # counts agree, but samples belong to other rays
        return relative_error(found[2], _exact_depths(*sets[0], exact))

    # Minimum bytes: read the rays (and the jitter), look up a byte for each stratum, write the kept samples.
    amount = 32.0 * rays + n * (5.0 if jitter else 1.0) + 24.0 * exact.ray_index.shape[0] + 8.0 * rays
    return Work(
        lambda backend: contender(functools.partial(ops.march_rays, backend=backend)),
        {"torch, all strata and a mask": lambda: contender(_march_masked)},
        error,
        0.01,  # rounding may move a sample across a border of its grid cell
        amount,
        "copy",
    )


def _shell() -> Tensor:
    """Returns a grid in which a thick spherical shell is occupied, about a tenth of the cells."""
    middles = (torch.arange(GRID) + 0.5) / GRID * 2 - 1
    x, y, z = torch.meshgrid(middles, middles, middles, indexing="ij")
    return ((x * x + y * y + z * z).sqrt() - 0.7).abs() < 0.07


def _exact_depths(rays: list[Tensor], uniforms: Tensor | None, found: Any) -> Tensor:
    """Returns the float64 depths of the kept samples."""
    near, far = (rays[i].double()[found.ray_index.long()] for i in (2, 3))
    # The depth determines the stratum, because rounding does not move a depth out of its stratum.
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
    """Marches without the op, as a user would: the cell of every sample, then a mask of occupied samples."""
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


def _balance_work(n: int, k: int, device: torch.device) -> Work:
    def batch(seed: int) -> list[Tensor]:
        random = generator(seed)
        # Clumps of unequal weight, like importance near surfaces.
        middles, chosen = torch.randn(40, 3, generator=random), torch.randint(0, 40, (n,), generator=random)
        samples = middles[chosen] + 0.2 * torch.randn(n, 3, generator=random)
        masses = torch.rand(n, generator=random, dtype=torch.float64) ** 4
        return [tensor.to(device) for tensor in (samples, masses, samples[torch.randperm(n, generator=random)[:k]])]

    sets = [batch(seed) for seed in range(4)]
    before = _spread_of_masses(sets[0], sets[0][2])

    def contender(function: Callable[..., Any]) -> Contender:
        return Contender(lambda call: function(*sets[call % len(sets)]))

    def error(found: Any) -> float:
        """Returns the imbalance after balancing, divided by the imbalance before.

        Centres are not compared, because 500 steps amplify rounding.
        """
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
    """Runs the published balancing update in a Python loop; `find` returns the mass in each cell."""
    for _ in range(STEPS):
        weights = find(samples, masses, centres)
        others = torch.cdist(centres, centres).topk(min(9, centres.shape[0]), largest=False).indices[:, 1:]
        heaviest = torch.maximum(weights[others].amax(1), weights)[:, None]
        pull = ((weights[others] - weights[:, None]) / heaviest.clamp(min=1e-30)).to(centres.dtype)
        centres = centres + 0.05 * ((centres[others] - centres[:, None]) * pull[..., None]).mean(1)
    return centres, find(samples, masses, centres)


def _spread_of_masses(batch: list[Tensor], centres: Tensor) -> float:
    """Returns std(W / max W) over the cells, where W is the mass of a cell."""
    weights = _masses_cdist(batch[0].double(), batch[1], centres.double())
    return float((weights / weights.max()).std())
