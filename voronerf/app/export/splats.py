"""The surface of a trained run as 3D Gaussians ("splats"), in the file layout of Kerbl et al. 2023.

n Gaussians, p pixels of a view, m pairs of a Gaussian and a pixel that it covers. A Gaussian starts at what a pixel of
a training view shows, flat along the surface and as wide as its neighbours are apart. All are then fitted to the run's
own pictures by gradient descent. A pixel composites the Gaussians that cover it from front to back (their equation 3),
which is volume rendering with an optical depth of -log(1 - alpha) each.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor
from torch.nn.functional import normalize

from voronerf.app.export.space import Track, View, check_export, in_silence, spread_around, views_of
from voronerf.app.files import write_bytes
from voronerf.app.render.paths import quaternions, rotations
from voronerf.app.run import Run
from voronerf.app.train.config import ConfigError
from voronerf.nerf.cameras import Cameras
from voronerf.ops import cell_sort, composite

SUFFIXES = (".ply",)
#: Training views that are fitted at the most, held-out views that are scored, and pixels along their longer side.
VIEWS, SCORED, LONGEST = 48, 8, 320
#: Points that a normal is computed from, and neighbours whose mean distance gives the width of a Gaussian.
NEIGHBOURS, CLOSE = 12, 3
#: Thickness of a Gaussian beside its width, and its opacity, at first.
THIN, OPAQUE = 0.2, 0.8
#: Pairs of a smaller alpha, and pairs behind so little transmittance, are left out.
FAINT, BEHIND = 1 / 255, 1e-3
#: Variance in square pixels that renderers of splats add to each, so that it covers a pixel's middle.
DILATION = 0.3
#: Pixels of a Gaussian's radius at the most; larger ones are before a camera's nose.
WIDEST = 64
#: Hundredths of the fit after which the pairs are found anew, since the Gaussians have moved.
AGAIN = (25, 60)
#: What `find_pairs` gives.
Pairs = tuple[Tensor, Tensor, Tensor, Tensor]
#: Constants of the spherical harmonics of degree 0 and 1.
SH_0, SH_1 = 0.28209479177387814, 0.4886025119029199
#: Adam's learning rates by the names of `Splats`; that of positions is a share of the median width.
RATES = {"positions": 0.15, "turns": 0.015, "scales": 0.03, "opacities": 0.15, "colours": 0.03}


@dataclass
class Splats:
    """Gaussians, by the numbers that the file holds.

    Attributes:
        positions: [n, 3], in scene units.
        turns: [n, 4], quaternions (w, x, y, z) from the axes of each to the scene's; of any length.
        scales: [n, 3], logarithms of the standard deviations along its axes.
        opacities: [n], logits.
        colours: [n, 4, 3], coefficients of spherical harmonics of degree 0 and 1; 0.5 is added to their sum.
    """

    positions: Tensor
    turns: Tensor
    scales: Tensor
    opacities: Tensor
    colours: Tensor

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, rows: Tensor) -> Splats:
        return Splats(*(value[rows] for value in vars(self).values()))

    def moved(self, transform: Tensor) -> Splats:
        """Turned, scaled and moved by a similarity float64 [4, 4]; its colours turn with it."""
        scale = float(torch.linalg.det(transform[:3, :3])) ** (1 / 3)
        turn = (transform[:3, :3] / scale).to(self.positions)
        # Degree 1 is linear in the direction: it goes by -y, z, -x.
        x, y, z = (turn @ torch.stack((-self.colours[:, 3], -self.colours[:, 1], self.colours[:, 2]), 1)).unbind(1)
        return Splats(
            (self.positions.double() @ transform[:3, :3].T + transform[:3, 3]).float(),
            quaternions(turn @ rotations(normalize(self.turns, dim=-1))),
            self.scales + math.log(scale),
            self.opacities,
            torch.stack((self.colours[:, 0], -y, z, -x), 1),
        )

    def bytes(self) -> bytes:
        """A binary .ply with the properties that viewers of splats read."""
        names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        names += [*(f"f_rest_{i}" for i in range(9)), "opacity", "scale_0", "scale_1", "scale_2"]
        names += [f"rot_{i}" for i in range(4)]
        header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(self)}"]
        header += [*(f"property float {name}" for name in names), "end_header", ""]
        rest = self.colours[:, 1:].mT.flatten(1)  # channel by channel
        place, colour = (self.positions, torch.zeros_like(self.positions)), (self.colours[:, 0], rest)
        values = (*place, *colour, self.opacities[:, None], self.scales, normalize(self.turns, dim=-1))
        return "\n".join(header).encode() + torch.cat(values, 1).numpy().astype("<f4").tobytes()


def export_splats(
    run: Run,
    path: Path | str,
    *,
    count: int = 100_000,
    seconds: float = 60.0,
    box: Tensor | None = None,
    to_files: bool = False,
    track: Track = in_silence,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[Splats, dict[str, float]]:
    """Writes the surface of a run as 3D Gaussians that are fitted to the run's own pictures.

    Args:
        run: The run.
        path: File to write, .ply.
        count: Gaussians at the most.
        seconds: Of fitting.
        box: [2, 3], what is exported; None for everything.
        to_files: Positions are those of the scene's files, rather than the scene's.
        track: Shows progress: yields the items of a sequence, and is given its name.
        clock: Counts seconds.

    Returns:
        The Gaussians in scene units, and "before" and "after": PSNR in dB of their pictures of held-out views against
        the run's own, at first and as fitted.

    Raises:
        ConfigError: A count below 1, negative seconds, an empty box, or views that show nothing.
        ImportError: A package of the extra is missing.
        ValueError: Another suffix.
        OSError: The file cannot be written.

    Examples:
        >>> from voronerf.app import Run
        >>> from voronerf.app.export import export_splats
        >>> def likeness(run: Run) -> float:
        ...     return export_splats(run, "scene.ply")[1]["after"]
    """
    path = Path(path)
    check_export(path, SUFFIXES)
    if count < 1:
        raise ConfigError(f"--count must be at least 1, got {count}")
    if not 0 <= seconds < math.inf:
        raise ConfigError(f"--fit must be 0 or more seconds, got {seconds}")
    run = run if box is None else run.cropped(box)
    background = run.scene.background_colour()
    background = torch.zeros(3) if background is None else background
    held_out = views_of(run, _small(run.scene.test.cameras), SCORED)
    views = views_of(run, _small(run.scene.train.cameras), VIEWS, track)
    splats = _first(views, count, run)
    scores = {"before": _score(splats, held_out, background)}
    fit(splats, views, background, seconds=seconds, track=track, clock=clock)
    scores["after"] = _score(splats, held_out, background)
    transform = run.scene.transform if to_files else None
    write_bytes(path, (splats if transform is None else splats.moved(torch.linalg.inv(transform))).bytes())
    return splats, scores


def _small(cameras: Cameras) -> Cameras:
    """Cameras without distortion, of at most ``LONGEST`` pixels."""
    factor = -(-max(cameras.width, cameras.height) // LONGEST)
    return replace(cameras, distortion=None, models=None, sizes=None).downscaled(factor)


def _first(views: list[View], count: int, run: Run) -> Splats:
    """Flat Gaussians at random points of the views, as wide as they are apart."""
    points = torch.cat([view.surface.reshape(-1, 3) for view in views])
    colours = torch.cat([view.colour.reshape(-1, 3) for view in views])
    shown = points.isfinite().all(-1).nonzero()[:, 0]
    if run.scene.box is not None:
        low, high = run.scene.box
        shown = shown[((points[shown] >= low) & (points[shown] <= high)).all(-1)]
    if len(shown) < 4:
        raise ConfigError(f"{run.path}: the training views show no surface")
    chosen = shown[torch.randperm(len(shown), generator=torch.Generator().manual_seed(0))[:count]]
    points = points[chosen].contiguous()
    axes, apart = spread_around(points, NEIGHBOURS)  # the normal comes first
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    width = apart[:, 1 : CLOSE + 1].mean(-1).clamp_min(1e-7)
    scales = width[:, None] * torch.tensor((THIN, 1.0, 1.0))
    harmonics = torch.zeros(len(points), 4, 3)
    harmonics[:, 0] = (colours[chosen] - 0.5) / SH_0
    opacities = torch.full((len(points),), math.log(OPAQUE / (1 - OPAQUE)))
    return Splats(points, quaternions(axes), scales.log(), opacities, harmonics)


# --- pictures of Gaussians ------------------------------------------------------------------------------------------


def flatten(splats: Splats, camera: Cameras) -> tuple[Tensor, Tensor]:
    """What a camera sees of each Gaussian, and its depth.

    Returns:
        rows [n, 9]: the middle x, y in pixels, the inverse covariance xx, xy, yy, the opacity, and the colour; and
        depth [n], along the camera's axis.
    """
    pose, (fx, fy, cx, cy) = camera.poses[0], camera.intrinsics[0]
    away = splats.positions - pose[:3, 3]
    local = away @ pose[:3, :3]
    depth = -local[:, 2]
    z = depth.clamp_min(1e-6)
    u, v = local[:, 0] / z, -local[:, 1] / z
    # Derivatives of the pixel by the place (Zwicker et al. 2001), with slopes bounded as usual.
    bound_u, bound_v = 0.65 * camera.width / fx, 0.65 * camera.height / fy
    nought = torch.zeros_like(z)
    across = torch.stack((fx / z, nought, fx * u.clamp(-bound_u, bound_u) / z), -1)
    down = torch.stack((nought, -fy / z, fy * v.clamp(-bound_v, bound_v) / z), -1)
    axes = pose[:3, :3].T @ rotations(normalize(splats.turns, dim=-1)) * splats.scales.exp()[:, None]
    seen = torch.stack((across, down), 1) @ axes
    xx, yy = (seen.square().sum(-1) + DILATION).unbind(-1)
    xy = (seen[:, 0] * seen[:, 1]).sum(-1)
    area = xx * yy - xy * xy
    harmonics = SH_1 * normalize(away, dim=-1)[:, (1, 2, 0)] * away.new_tensor((-1, 1, -1))
    colour = 0.5 + SH_0 * splats.colours[:, 0] + (harmonics[..., None] * splats.colours[:, 1:]).sum(1)
    rows = torch.stack((fx * u + cx, fy * v + cy, yy / area, -xy / area, xx / area, splats.opacities.sigmoid()), -1)
    return torch.cat((rows, colour.clamp_min(0)), -1), depth


def _alphas(rows: Tensor, pixels: Tensor, width: int) -> Tensor:
    """Alphas [m] of pairs, from rows [m, 9] and numbers of pixels [m]."""
    x = (pixels % width) + 0.5 - rows[:, 0]
    y = torch.div(pixels, width, rounding_mode="floor") + 0.5 - rows[:, 1]
    power = rows[:, 2] * x * x + 2 * rows[:, 3] * x * y + rows[:, 4] * y * y
    return (rows[:, 5] * torch.exp(-0.5 * power)).clamp_max(0.99)


@torch.no_grad()
def find_pairs(splats: Splats, camera: Cameras) -> Pairs:
    """Which Gaussians cover which pixels of a camera, from front to back.

    Returns:
        (Gaussians that are seen int64 [s], which of these a pair has int64 [m], its pixel int64 [m] in ascending order,
        offsets int32 [p + 1] of the pixels' pairs).
    """
    width, height = camera.width, camera.height
    rows, depth = flatten(splats, camera)
    # Alpha falls to FAINT at this many standard deviations; a box around the ellipse has the roots of the covariance.
    reach = (2 * (rows[:, 5] / FAINT).clamp_min(1).log()).sqrt()
    inverse = 1 / (rows[:, 2] * rows[:, 4] - rows[:, 3].square())
    extent = reach[:, None] * torch.stack((rows[:, 4] * inverse, rows[:, 2] * inverse), -1).clamp_min(0).sqrt()
    extent = extent.clamp_max(WIDEST)
    limit = extent.new_tensor((width, height))
    low = (rows[:, :2] - extent - 0.5).ceil().clamp_min(0).clamp_max(limit)
    high = ((rows[:, :2] + extent - 0.5).floor() + 1).clamp_min(0).clamp_max(limit)
    size = (high - low).clamp_min(0).nan_to_num(0).long()
    size[~(depth > 1e-3)] = 0
    order = torch.where(size.prod(-1) > 0, depth, torch.inf).argsort()[: int((size.prod(-1) > 0).sum())]
    counts = size[order].prod(-1)
    which = torch.repeat_interleave(order, counts)
    place = torch.arange(len(which)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    left, top, columns = low[:, 0].long()[which], low[:, 1].long()[which], size[:, 0][which]
    pixels = (top + torch.div(place, columns, rounding_mode="floor")) * width + left + place % columns
    alphas = _alphas(rows[which], pixels, width)
    kept = alphas >= FAINT
    which, pixels, alphas = which[kept], pixels[kept], alphas[kept]
    sorting, offsets = cell_sort(pixels.int(), width * height)
    which, pixels, alphas = (value[sorting.long()] for value in (which, pixels, alphas))
    passed = torch.log1p(-alphas.double()).cumsum(0)
    starts = torch.cat((passed.new_zeros(1), passed))[offsets[:-1].long()]
    before = passed - torch.log1p(-alphas.double()) - starts[pixels]
    kept = before > math.log(BEHIND)
    counted = torch.bincount(pixels[kept], minlength=width * height).cumsum(0)
    used, place = which[kept].unique(return_inverse=True)
    return used, place, pixels[kept], torch.cat((counted.new_zeros(1), counted)).int()


def picture(splats: Splats, camera: Cameras, background: Tensor, pairs: Pairs | None = None) -> Tensor:
    """What a camera sees of Gaussians, [h, w, 3]; differentiable in them for given pairs."""
    used, place, pixels, offsets = find_pairs(splats, camera) if pairs is None else pairs
    rows = flatten(splats[used], camera)[0][place]
    depths = -torch.log1p(-_alphas(rows, pixels, camera.width))
    ones = torch.ones_like(depths)
    found = composite(depths, rows[:, 6:], ones, ones, ray_offsets=offsets, background=background)
    return found.colour.view(camera.height, camera.width, 3)


@torch.no_grad()
def _score(splats: Splats, views: list[View], background: Tensor) -> float:
    """PSNR in dB, the mean over the views."""
    errors = [(picture(splats, view.camera, background) - view.colour).square().mean() for view in views]
    return float(-10 * torch.stack(errors).clamp_min(1e-10).log10().mean())


def fit(
    splats: Splats,
    views: list[View],
    background: Tensor,
    *,
    seconds: float,
    track: Track = in_silence,
    clock: Callable[[], float] = time.perf_counter,
) -> int:
    """Fits Gaussians to views by Adam, in place; returns the number of steps."""
    width = float(splats.scales.exp().median())
    values = vars(splats)
    rates = {name: rate * (width if name == "positions" else 1) for name, rate in RATES.items()}
    adam = torch.optim.Adam(
        [{"params": [values[name].requires_grad_()], "lr": rate, "rate": rate} for name, rate in rates.items()],
        eps=1e-15,
    )
    known: dict[int, Pairs] = {}
    draw = torch.Generator().manual_seed(0)
    numbers: list[int] = []
    started, step = clock(), 0
    for hundredth in track(range(100), "fitting"):
        if hundredth in AGAIN:
            known.clear()
        while clock() - started < seconds * (hundredth + 1) / 100:
            for group in adam.param_groups:
                group["lr"] = group["rate"] * 0.1 ** (hundredth / 100)
            numbers = numbers or torch.randperm(len(views), generator=draw).tolist()
            number = numbers.pop()
            view = views[number]
            if number not in known:
                known[number] = find_pairs(splats, view.camera)
            error = (picture(splats, view.camera, background, known[number]) - view.colour).square().mean()
            adam.zero_grad()
            error.backward()
            adam.step()
            step += 1
    for value in values.values():
        value.requires_grad_(False)
    return step
