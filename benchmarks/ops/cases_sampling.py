"""Cases of frequency_encode, spherical_harmonics, composite, resample and march_rays.

n points, samples, or strata of all rays in march_rays; r rays.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from ops.alternatives import compile_now
from ops.case import BACKWARD, FORWARD, Case, Contender, Work, generator, relative_error, rotation, uniform_points
from ops.route import torch_encode
from voronerf import ops

FULL, HALF = torch.float32, torch.bfloat16
BASE = 1 << 18
ALL = ("native", "reference", "warp")
OCTAVES = 10
DEGREE = 4
SAMPLES = STRATA = 64
"""Samples per ray, for packed rays their mean number, and strata per ray."""
GRID = 64
"""Cells of the marched grid along each axis."""
FINE = 128
"""The number of depths that resample draws from SAMPLES bins."""
CHECKED = 4096
"""The number of rows or rays compared with float64."""

Function = Callable[..., Any]


def cases() -> list[Case]:
    """Returns the cases of these ops."""
    rows = []
    for n, dtype, direction in (
        (BASE, FULL, FORWARD),
        (BASE, FULL, BACKWARD),
        (BASE, HALF, FORWARD),
        *[(n, FULL, FORWARD) for n in (1 << 10, 1 << 14, 1 << 20)],
    ):
        base = (n, dtype) == (BASE, FULL)
        work = functools.partial(_encode_work, "frequency_encode", n, dtype, direction, base)
        shown, quick = ALL if base else ("native",), base and direction == FORWARD
        rows.append(Case("frequency_encode", f"L={OCTAVES} n={n}", dtype, direction, n, None, work, shown, quick))
    for n, direction in ((BASE, FORWARD), (BASE, BACKWARD), (1 << 14, FORWARD)):
        base = n == BASE
        work = functools.partial(_encode_work, "spherical_harmonics", n, FULL, direction, base)
        shown = ALL if base else ("native",)
        quick = base and direction == FORWARD
        rows.append(Case("spherical_harmonics", f"degree {DEGREE} n={n}", FULL, direction, n, None, work, shown, quick))
    for n, packed, direction in (
        *[(BASE, packed, direction) for packed in (False, True) for direction in (FORWARD, BACKWARD)],
        *[(n, False, direction) for n in (1 << 10, 1 << 14, 1 << 20) for direction in (FORWARD, BACKWARD)],
    ):
        base = n == BASE
        kind = "packed" if packed else "dense"
        work = functools.partial(_composite_work, n, packed, direction)
        shown = ALL if base else ("native",)
        quick = base and direction == FORWARD
        rows.append(Case("composite", f"{kind} n={n}", FULL, direction, n, None, work, shown, quick))
    for n in (BASE, 1 << 10, 1 << 14, 1 << 20):
        work = functools.partial(_resample_work, n)
        name = f"{SAMPLES} bins {FINE} depths n={n}"
        base = n == BASE
        rows.append(Case("resample", name, FULL, FORWARD, n, None, work, ALL if base else ("native",), base))
    for n, jitter in ((BASE, False), (BASE, True), (1 << 22, False)):
        name = f"{'jittered' if jitter else 'middles'} {GRID}^3 n={n}"
        base, work = n == BASE, functools.partial(_march_work, n, jitter)
        shown = ALL if base else ("native",)
        rows.append(Case("march_rays", name, FULL, FORWARD, n, None, work, shown, base and not jitter))
    return rows


def _contender(function: Function, sets: Sequence[Sequence[Tensor]], gradients: Sequence[Tensor] | None) -> Contender:
    """Returns a contender that calls a function; with ``gradients`` it also computes input gradients."""

    def forward(call: int) -> Any:
        with torch.no_grad():
            return function(*sets[call % len(sets)])

    def both(call: int) -> tuple[Any, Any]:
        inputs = [t.detach().requires_grad_() if t.is_floating_point() else t for t in sets[call % len(sets)]]
        results = function(*inputs)
        outputs = [results] if isinstance(results, Tensor) else list(results)
        wanted = [tensor for tensor in inputs if tensor.requires_grad]
        return results, torch.autograd.grad(outputs[: len(gradients or ())], wanted, gradients)

    return Contender(forward if gradients is None else both)


def _flat(result: Any) -> list[Tensor]:
    """Returns all tensors of a nested result."""
    return [result] if isinstance(result, Tensor) else [tensor for part in result for tensor in _flat(part)]


def _work(
    op: Function,
    functions: dict[str, Function],
    sets: Sequence[Sequence[Tensor]],
    gradients: Sequence[Tensor] | None,
    checked: Callable[[list[Tensor]], list[Tensor]],
    exact: Callable[[], list[Tensor]],
    amount: float,
    compiled: Sequence[str],
    tolerance: float,
) -> Work:
    """Builds the case of a plain function.

    Args:
        op: The operation, with an argument ``backend``.
        functions: The alternatives by name; they take the arguments of the op.
        sets: The arguments of consecutive calls.
        gradients: Output gradients, one for each of the op's first outputs; None for a forward case.
        checked: A function of a flat result that returns the compared tensors.
        exact: A function that returns the compared tensors in float64.
        amount: The least number of bytes that a call reads and writes.
        compiled: Names of the alternatives that are also measured with torch.compile.
        tolerance: The largest error of an alternative.
    """
    expected: list[Tensor] = []

    def error(result: Any) -> float:
        if not expected:
            expected.extend(exact())
        return max(relative_error(a, b) for a, b in zip(checked(_flat(result)), expected))

    def compiling(function: Function) -> Contender:
        torch.compiler.reset()  # forgets the shapes of earlier rows
        contender = _contender(torch.compile(function), sets, gradients)
        compile_now(lambda: contender.run(1))
        return contender

    alternatives: dict[str, Callable[[], Contender]] = {
        name: functools.partial(_contender, function, sets, gradients) for name, function in functions.items()
    }
    for name in compiled:
        alternatives[f"{name}, torch.compile"] = functools.partial(compiling, functions[name])
    return Work(
        lambda backend: _contender(functools.partial(op, backend=backend), sets, gradients),
        alternatives,
        error,
        tolerance,
        amount,
        "copy",
    )


def _encode_work(op: str, n: int, dtype: torch.dtype, direction: str, compiled: bool, device: torch.device) -> Work:
    """Builds a case of frequency_encode or of spherical_harmonics; ``compiled`` adds torch.compile."""
    waves, run = op == "frequency_encode", getattr(ops, op)
    order, features = (OCTAVES, 6 * OCTAVES + 3) if waves else (DEGREE, DEGREE**2)
    sets = [[uniform_points(n, seed, device)] for seed in range(rotation(n * (12 + features * dtype.itemsize)))]
    sets = [[(x if waves else F.normalize(x - 0.5, dim=1)).to(dtype)] for (x,) in sets]
    gradients = None
    if direction == BACKWARD:
        gradients = [torch.randn(n, features, generator=generator(5)).to(device, dtype)]
    step = max(1, n // CHECKED)

    def exact() -> list[Tensor]:
        rows = [sets[0][0][::step].double().contiguous()]
        given = None if gradients is None else [gradients[0][::step].double()]
        return _flat(_contender(lambda x: run(x, order, backend="reference"), [rows], given).run(0))

    functions: dict[str, Function] = {"torch, value by value": harmonics_by_value}
    if waves:
        at_once = functools.partial(torch_encode, octaves=OCTAVES, dtype=dtype)
        functions = {"torch, octave by octave": _frequency_by_octave, "torch, all octaves at once": at_once}
    # Minimum bytes: forward reads points and writes features; backward reads points and gradients, writes gradients.
    amount = float(n) * (3 + features) * dtype.itemsize
    if direction == BACKWARD:
        amount += float(n) * (6 + features) * dtype.itemsize
    # bfloat16 rounds angles of hundreds of radians by more than a radian.
    tolerance = 1.5 if dtype == HALF else 1e-3 if waves else 1e-5
    return _work(
        lambda x, backend: run(x, order, backend=backend),
        functions,
        sets,
        gradients,
        lambda found: [tensor[::step] for tensor in found],
        exact,
        amount,
        list(functions)[:compiled],  # the other alternative is slower, especially backward
        tolerance,
    )


def harmonics_by_value(directions: Tensor) -> Tensor:
    """Computes spherical harmonics [n, 16] of unit directions [n, 3] column by column, as nerfstudio does."""
    x, y, z = directions.unbind(1)
    xx, yy, zz = x**2, y**2, z**2
    out = directions.new_empty(directions.shape[0], 16)
    out[:, 0] = 0.28209479177387814
    out[:, 1] = -0.4886025119029199 * y
    out[:, 2] = 0.4886025119029199 * z
    out[:, 3] = -0.4886025119029199 * x
    out[:, 4] = 1.0925484305920792 * x * y
    out[:, 5] = -1.0925484305920792 * y * z
    out[:, 6] = 0.9461746957575601 * zz - 0.31539156525251999
    out[:, 7] = -1.0925484305920792 * x * z
    out[:, 8] = 0.5462742152960396 * (xx - yy)
    out[:, 9] = -0.5900435899266435 * y * (3 * xx - yy)
    out[:, 10] = 2.890611442640554 * x * y * z
    out[:, 11] = -0.4570457994644658 * y * (5 * zz - 1)
    out[:, 12] = 0.3731763325901154 * z * (5 * zz - 3)
    out[:, 13] = -0.4570457994644658 * x * (5 * zz - 1)
    out[:, 14] = 1.445305721320277 * z * (xx - yy)
    out[:, 15] = -0.5900435899266435 * x * (xx - 3 * yy)
    return out


def _frequency_by_octave(x: Tensor) -> Tensor:
    parts = [x]
    for octave in range(OCTAVES):
        parts += [torch.sin(x * 2.0**octave), torch.cos(x * 2.0**octave)]
    return torch.cat(parts, 1)


def _composite_work(n: int, packed: bool, direction: str, device: torch.device) -> Work:
    rays = n // SAMPLES
    ray_offsets = None
    shape: tuple[int, ...] = (rays, SAMPLES)
    if packed:
        # Lengths between 0 and twice the mean.
        lengths = torch.randint(0, 2 * SAMPLES + 1, (rays,), generator=generator(2))
        ray_offsets = torch.nn.functional.pad(lengths.cumsum(0), (1, 0)).to(device, torch.int32)
        shape = (int(lengths.sum()),)
    total = shape[0] if packed else n

    def samples(seed: int) -> list[Tensor]:
        random = generator(seed)
        sigma = torch.rand(shape, generator=random) * 10
        rgb = torch.rand(*shape, 3, generator=random)
        deltas = torch.rand(shape, generator=random) * 0.02 + 0.01
        depths = deltas.cumsum(-1) if not packed else torch.rand(shape, generator=random) + 1
        return [tensor.to(device) for tensor in (sigma, rgb, depths, deltas)]

    sets = [samples(seed) for seed in range(rotation(28 * total))]
    gradients = None
    if direction == BACKWARD:
        gradients = [torch.randn(rays, width, generator=generator(5)).to(device) for width in (3, 1, 1)]
        gradients = [gradients[0], *(tensor[:, 0].contiguous() for tensor in gradients[1:])]
    extra = {"ray_offsets": ray_offsets} if packed else {}

    def exact() -> list[Tensor]:
        wide = [[tensor.double() for tensor in sets[0]]]
        given = None if gradients is None else [tensor.double() for tensor in gradients]
        reference = functools.partial(ops.composite, **extra, backend="reference")
        return _flat(_contender(reference, wide, given).run(0))

    functions: dict[str, Function] = (
        {"torch, running sum + index_add": functools.partial(_composite_packed, ray_offsets)}
        if ray_offsets is not None
        else {"torch cumprod": _composite_cumprod, "torch cumsum": _composite_cumsum}
    )
    # Minimum bytes: forward reads density, colour, depth and length of a sample and writes its weight. Backward reads
    # these inputs again and writes their gradients.
    bytes_a_sample = 28.0 if direction == FORWARD else 28.0 + 24.0 + 24.0
    return _work(
        functools.partial(ops.composite, **extra),
        functions,
        sets,
        gradients,
        lambda found: found,
        exact,
        bytes_a_sample * total,
        [],
        1e-3,
    )


def _rendered(weights: Tensor, rgb: Tensor, depths: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return (weights[..., None] * rgb).sum(1), weights.sum(1), (weights * depths).sum(1), weights


def _composite_cumprod(sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor) -> Any:
    """Composites by cumprod, as nerf-pytorch does."""
    passing = torch.exp(-sigma * deltas)
    front = torch.cumprod(torch.cat([torch.ones_like(passing[:, :1]), passing[:, :-1] + 1e-10], 1), 1)
    return _rendered((1 - passing) * front, rgb, depths)


def _composite_cumsum(sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor) -> Any:
    """Composites by cumsum in logarithms, as mip-NeRF's successors do."""
    optical = sigma * deltas
    front = torch.exp(-F.pad(optical[:, :-1].cumsum(1), (1, 0)))
    return _rendered(front * -torch.expm1(-optical), rgb, depths)


def _composite_packed(
    ray_offsets: Tensor, sigma: Tensor, rgb: Tensor, depths: Tensor, deltas: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Composites packed rays: one float64 cumsum over all rays, minus its value at the ray's start."""
    rays = ray_offsets.shape[0] - 1
    ray = torch.repeat_interleave(torch.arange(rays, device=sigma.device), ray_offsets.diff())
    optical = sigma * deltas
    running = F.pad(optical.double().cumsum(0), (1, 0))
    front = torch.exp(-(running[:-1] - running[ray_offsets.long()][ray])).to(sigma.dtype)
    weights = front * -torch.expm1(-optical)
    columns = torch.cat([rgb, torch.ones_like(depths)[:, None], depths[:, None]], 1) * weights[:, None]
    total = columns.new_zeros(rays, 5).index_add(0, ray, columns)
    return total[:, :3], total[:, 3], total[:, 4], weights


def _resample_work(n: int, device: torch.device) -> Work:
    rays = max(1, n // SAMPLES)

    def bins(seed: int) -> list[Tensor]:
        random = generator(seed)
        weights = torch.rand(rays, SAMPLES, generator=random) ** 4 + 1e-3
        edges = (torch.rand(rays, SAMPLES + 1, generator=random) + 0.1).cumsum(1)
        return [weights.to(device), edges.to(device)]

    sets = [bins(seed) for seed in range(rotation(4 * rays * (2 * SAMPLES + 1)))]
    step = max(1, rays // CHECKED)

    def exact() -> list[Tensor]:
        weights, edges = (tensor[::step].double() for tensor in sets[0])
        return [ops.resample(weights, edges, FINE, backend="reference")]

    return _work(
        lambda weights, edges, backend: ops.resample(weights, edges, FINE, backend=backend),
        {"torch cumsum + searchsorted": _resample_torch},
        sets,
        None,
        lambda found: [found[0][::step]],
        exact,
        4.0 * rays * (2 * SAMPLES + 1 + FINE),
        ["torch cumsum + searchsorted"] if n == BASE else [],
        1e-2,
    )


def _resample_torch(weights: Tensor, edges: Tensor) -> Tensor:
    """Resamples as nerf-pytorch's sample_pdf does, at the middles of equal strata."""
    cdf = F.pad((weights / weights.sum(1, keepdim=True)).cumsum(1), (1, 0))
    middles = (torch.arange(FINE, dtype=weights.dtype, device=weights.device) + 0.5) / FINE
    u = middles.expand(weights.shape[0], FINE).contiguous()
    above = torch.searchsorted(cdf, u, right=True).clamp(max=SAMPLES)
    low, high = cdf.gather(1, above - 1), cdf.gather(1, above)
    inside = (u - low) / (high - low).clamp(min=1e-10)
    near, far = edges.gather(1, above - 1), edges.gather(1, above)
    return near + inside * (far - near)


def _march_work(n: int, jitter: bool, device: torch.device) -> Work:
    rays = n // STRATA
    box, occupied = torch.tensor(((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))).to(device), _shell().to(device)

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
