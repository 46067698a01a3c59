"""The rival: Instant NGP in pure PyTorch on the CPU, faster than the public implementations.

It follows published descriptions: the hash grid of nerfstudio's ``HashEncoding(implementation="torch")``; the
networks, the occupancy grid and the adaptive number of rays of nerfacc's ``train_ngp_nerf_occ.py``; the averaged
weights of torch-ngp. One network covers the whole scene. Only images, rays and scores come from voronerf.

It uses the fastest table lookup in pure PyTorch. Forward and backward of 8 levels take, in ns per sample on one thread
of a Zen 5: 3,950 by indexing, 8,800 by ``F.embedding``, 4,300 by ``F.embedding_bag``, and 370 by ``F.embedding_bag``
forward with ``scatter_add_`` backward.

Letters: n kept samples, r rays, s strata of a ray, l levels of the grid.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from ops.cases_sampling import harmonics_by_value
from torch import Tensor, nn

from voronerf.app.evaluate.metrics import psnr, ssim
from voronerf.app.evaluate.scores import ViewScore, mean_scores, view_numbers
from voronerf.app.scenes import Scene
from voronerf.app.train import TrainConfig
from voronerf.app.train.build import make_batches
from voronerf.nerf.cameras import Rays
from voronerf.nerf.contraction import Contraction
from voronerf.nerf.rays import intersect_box
from voronerf.nerf.sampling import stratified_depths

PRIMES = (1, 2654435761 - 2**32, 805459861)
#: Rays rendered at a time in an evaluation, and cells of the occupancy grid evaluated at a time.
CHUNK, CELLS_CHUNK = 4096, 1 << 16
#: Steps between updates of the occupancy grid (nerfacc).
GRID_EVERY = 16
#: A cell is occupied if its opacity exceeds the smaller of GRID_OPACITY and the mean opacity of all cells (nerfacc).
#: The opacity of a cell is its density times GRID_WAY diagonals of the scene.
GRID_OPACITY, GRID_WAY = 1e-2, 1e-3
#: Steps of the learning rate's warm-up (nerfacc: 100 of 20,000).
RISE = 20


@dataclass(frozen=True)
class RivalConfig:
    """Settings of the rival. The grid matches `--field hashgrid`; the other defaults are the best values tried."""

    levels: int = 8
    """The number of levels of the hash grid."""
    level_features: int = 2
    """The number of features of a level."""
    log2_entries: int = 15
    """The base-2 logarithm of the number of entries of a level."""
    base: float = 16
    """The coarsest resolution."""
    finest: float | None = None
    """The finest resolution. Default: grid cells as wide as half a pixel of the training views."""
    width: int = 64
    """The width of the hidden layers: one for the density, two for the colour."""
    samples: int = 64
    """The number of strata of a ray."""
    batch: int = 1 << 13
    """The target number of samples of a step; the number of rays is adapted to it."""
    resolution: int = 64
    """The number of cells of the occupancy grid along each axis."""
    grid_warmup: int = 64
    """The number of first steps in which each update of the occupancy grid evaluates all cells."""
    grid_decay: float = 0.8
    """The decay of a cell's stored opacity when the cell is evaluated again (nerfacc: 0.95)."""
    grid_share: float = 1 / 32
    """The fraction of the cells that each later update evaluates; half of the evaluated cells are occupied cells."""
    lr: float = 2e-2
    """The learning rate of Adam at the start (nerfacc: 0.01)."""
    lr_final: float = 0.1
    """The learning rate at the end, as a fraction of --lr; the decay is exponential."""
    average: float = 0.9
    """The decay per step of the weights' moving average, which evaluation uses (torch-ngp: 0.95)."""


class ReadTable(torch.autograd.Function):
    """A table look-up: returns weighted sums [m, f] of eight entries each from a table [entries, f]."""

    @staticmethod
    def forward(ctx: Any, table: Tensor, index: Tensor, weights: Tensor) -> Tensor:
        ctx.save_for_backward(index, weights)
        ctx.entries = table.shape[0]
        return F.embedding_bag(index, table, per_sample_weights=weights, mode="sum")

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None, None]:
        index, weights = ctx.saved_tensors
        (gradient,) = gradients
        found, flat = gradient.new_zeros(ctx.entries, gradient.shape[1]), index.reshape(-1).long()
        for feature in range(gradient.shape[1]):
            found[:, feature].scatter_add_(0, flat, (weights * gradient[:, feature, None]).reshape(-1))
        return found, None, None


class TruncatedExp(torch.autograd.Function):
    """The exponential with a bounded gradient, the activation of the density in torch-ngp and nerfacc."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.exp()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        (x,) = ctx.saved_tensors
        return gradients[0] * x.clamp(-15, 15).exp()


class NGP(nn.Module):
    """The field: maps positions in the unit cube and directions to colour and density."""

    def __init__(self, config: RivalConfig, finest: float) -> None:
        super().__init__()
        growth = (finest / config.base) ** (1 / max(config.levels - 1, 1))
        scales = torch.floor(config.base * growth ** torch.arange(config.levels))
        self.register_buffer("scales", scales[:, None])
        self.register_buffer("primes", torch.tensor(PRIMES, dtype=torch.int32))
        self.register_buffer("first", torch.arange(config.levels, dtype=torch.int32)[:, None] << config.log2_entries)
        self.entries, self.features = 1 << config.log2_entries, config.levels * config.level_features
        self.table = nn.Parameter(
            torch.empty(config.levels * self.entries, config.level_features).uniform_(-1e-4, 1e-4)
        )
        w = config.width
        self.geometry = nn.Sequential(_linear(self.features, w), nn.ReLU(), _linear(w, 16))
        self.colour = nn.Sequential(_linear(15 + 16, w), nn.ReLU(), _linear(w, w), nn.ReLU(), _linear(w, 3))

    def encode(self, positions: Tensor) -> Tensor:
        """Returns features [n, levels x features] of positions [n, 3] in 0..1."""
        places = positions[:, None] * self.scales
        corner = places.floor()
        above = places - corner
        low = corner.int() * self.primes
        corners, weights = (low, low + self.primes), (1 - above, above)
        x, y, z = ([(c[..., i], w[..., i]) for c, w in zip(corners, weights)] for i in range(3))
        plane = [(b ^ c, v * w) for b, v in y for c, w in z]
        index = torch.stack([a ^ b for a, _ in x for b, _ in plane], -1).bitwise_and_(self.entries - 1)
        index += self.first
        weight = torch.stack([u * v for _, u in x for _, v in plane], -1)
        return ReadTable.apply(self.table, index.view(-1, 8), weight.view(-1, 8)).view(-1, self.features)

    def forward(self, positions: Tensor, seen: Tensor, ray: Tensor) -> tuple[Tensor, Tensor]:
        """Returns colour [n, 3] and density [n] at positions [n, 3] in 0..1.

        ``seen`` holds the encoded directions [r, 16] of the rays, and ``ray`` the ray [n] of each position.
        """
        found = self.geometry(self.encode(positions))
        colour = self.colour(torch.cat((found[:, 1:], seen[ray]), 1)).sigmoid()
        return colour, TruncatedExp.apply(found[:, 0] - 1)

    def density(self, positions: Tensor) -> Tensor:
        """Returns the density [n] alone."""
        return TruncatedExp.apply(self.geometry(self.encode(positions))[:, 0] - 1)


def _linear(inputs: int, outputs: int) -> nn.Linear:
    """Returns a layer without bias, initialised as in nerfacc and tiny-cuda-nn."""
    layer = nn.Linear(inputs, outputs, bias=False)
    nn.init.xavier_uniform_(layer.weight)
    return layer


class Rival:
    """A training of the rival on a scene, which runs in turns and is evaluated like a ``turns.Training``.

    A scene without a box is contracted, as with ``--contraction sphere``, and has no occupancy grid.

    Args:
        config: The settings.
        scene: The scene to train on.
        budget: The training seconds.
        evaluations: The number of evaluations during the budget, evenly spaced, the last one at the end.
        eval_views: The number of test views in each evaluation.
        seed: The seed of all random choices.
        clock: A function that returns the time in seconds.
        on_event: A function that is called with a line of text for each evaluation.
    """

    def __init__(
        self,
        config: RivalConfig,
        scene: Scene,
        *,
        budget: float,
        evaluations: int,
        eval_views: int,
        seed: int,
        clock: Callable[[], float],
        on_event: Callable[[str], None] = print,
    ) -> None:
        self.config, self.scene, self.budget, self.clock, self.on_event = config, scene, budget, clock, on_event
        self.evaluations, self.eval_views = evaluations, eval_views
        self.generator = torch.Generator().manual_seed(seed)
        self.batches = make_batches(TrainConfig(), scene)
        self.contraction = scene.space("sphere").contraction if scene.box is None else None
        if scene.box is not None:
            self.low, self.size = scene.box[0], scene.box[1] - scene.box[0]
        elif isinstance(self.contraction, Contraction):
            self.low = self.contraction.centre - 2 * self.contraction.radius
            self.size = torch.full((3,), 4 * self.contraction.radius)
        finest = config.finest or max(round(2 * float(self.size.max()) / scene.pixel(scene.space("none"))), 32)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.field = NGP(config, finest)
        parameters = list(self.field.parameters())
        self.optimizer = torch.optim.Adam(parameters, lr=config.lr, betas=(0.9, 0.99), eps=1e-15, fused=True)
        self.averages = [p.detach().clone() for p in parameters]
        cells = config.resolution**3
        self.remembered, self.occupied = torch.zeros(cells), torch.ones(cells, dtype=torch.bool)
        self.rays = max(config.batch // config.samples, 1)
        self.step, self.seconds = 0, 0.0
        self.metrics: list[dict[str, Any]] = []

    def advance(self, until: float = math.inf) -> None:
        """Trains until ``until`` training seconds or the end of the budget, whichever comes first."""
        while self.seconds < min(until, self.budget):
            started = self.clock()
            self.train_step()
            self.seconds += self.clock() - started
            if self.seconds < self.budget and int(self.seconds / self.budget * self.evaluations) > len(self.metrics):
                self.evaluate()

    def run(self) -> dict[str, Any]:
        """Trains to the end of the budget and evaluates; returns the last scores and the sizes."""
        self.advance()
        self.evaluate()
        parameters = sum(p.numel() for p in self.field.parameters())
        return {**self.metrics[-1], "steps": self.step, "parameters": parameters, "stages": []}

    def train_step(self) -> None:
        """Runs one training step."""
        config, done = self.config, self.seconds / self.budget
        for group in self.optimizer.param_groups:
            group["lr"] = config.lr * min(1, 0.01 + self.step / RISE) * config.lr_final**done
        if self.contraction is None and self.step % GRID_EVERY == 0:
            self.update_grid()
        batch = self.batches.draw(self.rays, self.generator)
        colour, kept = self.render(batch.rays, batch.near, batch.far, batch.background, jitter=True)
        loss = F.mse_loss(colour, batch.target)
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        # torch-ngp's moving average, with a smaller decay in the first steps
        decay = min(config.average, (1 + self.step) / (10 + self.step))
        torch._foreach_lerp_(self.averages, [p.detach() for p in self.field.parameters()], 1 - decay)
        self.step += 1
        self.rays = min(max(self.rays * config.batch // max(kept, 1), 64), 1 << 13)

    def render(
        self, rays: Rays, near: Tensor, far: Tensor, background: Tensor | None, *, jitter: bool
    ) -> tuple[Tensor, int]:
        """Returns the colours [r, 3] of rays and the number of their samples."""
        s = self.config.samples
        generator = self.generator if jitter else None
        depths, deltas, _ = stratified_depths(
            near, far, s, jitter=jitter, spacing=self.scene.spacing, generator=generator
        )
        if self.contraction is None:
            origins, directions = (rays.origins - self.low) / self.size, rays.directions / self.size
            kept = self.occupied[self.cells_along(origins, directions, depths)].view(-1).nonzero()[:, 0]
        else:
            origins, directions, kept = rays.origins, rays.directions, torch.arange(depths.numel())
        ray = kept // s
        positions = torch.addcmul(origins[ray], directions[ray], depths.view(-1)[kept][:, None])
        if self.contraction is not None:
            positions = (self.contraction.points(positions) - self.low) / self.size
        colour, density = self.field(positions.clamp_(0, 1), harmonics_by_value(rays.directions), ray)
        # Rays are padded to all strata, so that one cumsum per ray suffices and rounding errors do not cross rays.
        flat = torch.zeros(depths.numel()).scatter(0, kept, density * deltas.reshape(-1)[kept])
        thickness = flat.view(-1, s)
        before = thickness.cumsum(1) - thickness
        weights = -torch.expm1(-thickness) * torch.exp(-before)
        found = weights.view(-1).gather(0, kept)[:, None] * colour
        result = torch.zeros_like(rays.origins).scatter_add(0, ray[:, None].expand(-1, 3), found)
        if background is not None:
            result = result + background * torch.exp(-thickness.sum(1, keepdim=True))
        return result, kept.numel()

    def cells_along(self, origins: Tensor, directions: Tensor, depths: Tensor) -> Tensor:
        """Returns the cells [r, s] of the occupancy grid at depths [r, s] along rays in the unit cube."""
        size, cell = self.config.resolution, None
        for axis in range(3):
            place = torch.addcmul(origins[:, axis, None], directions[:, axis, None], depths)
            place = place.mul_(size).clamp_(0, size - 1).int()
            cell = place if cell is None else cell.mul_(size).add_(place)
        assert cell is not None
        return cell

    @torch.no_grad()
    def update_grid(self) -> None:
        """Updates the occupancy grid: evaluates all cells in the first steps, then random cells and occupied cells."""
        config, every = self.config, self.remembered.numel()
        if self.step < config.grid_warmup:
            cells = torch.arange(every)
        else:
            count = max(int(every * config.grid_share / 2), 1)
            full = self.occupied.nonzero()[:, 0]
            drawn = torch.randint(every, (count,), generator=self.generator)
            chosen = torch.randint(max(len(full), 1), (min(count, len(full)),), generator=self.generator)
            cells = torch.cat((drawn, full[chosen]))
        size = config.resolution
        place = torch.stack((cells // size**2, cells // size % size, cells % size), 1)
        points = (place + torch.rand(len(cells), 3, generator=self.generator)) / size
        found = torch.cat([self.field.density(part) for part in points.split(CELLS_CHUNK)])
        opacity = found * (float(self.size.norm()) * GRID_WAY)
        self.remembered[cells] = torch.maximum(self.remembered[cells] * config.grid_decay, opacity)
        self.occupied = self.remembered > min(float(self.remembered.mean()), GRID_OPACITY)

    @torch.no_grad()
    def evaluate(self) -> None:
        """Evaluates test views with the averaged weights."""
        parameters = list(self.field.parameters())
        trained = [p.detach().clone() for p in parameters]
        for parameter, average in zip(parameters, self.averages):
            parameter.copy_(average)
        background, test = self.scene.background_colour(), self.scene.test
        scores = []
        for view in view_numbers(len(test), self.eval_views):
            truth = test.truth(view, background)
            rays = test.cameras.image_rays(view)
            near, far, _ = intersect_box(rays.origins, rays.directions, self.scene.box, self.scene.near, self.scene.far)
            found = []
            for at in range(0, len(near), CHUNK):
                part = slice(at, at + CHUNK)
                few = Rays(rays.origins[part], rays.directions[part])
                found.append(self.render(few, near[part], far[part], background, jitter=False)[0])
            image = torch.cat(found).view(truth.shape).clamp(0, 1)
            scores.append(ViewScore(test.names[view], float(psnr(image, truth)), float(ssim(image, truth))))
        for parameter, values in zip(parameters, trained):
            parameter.copy_(values)
        now = {"step": self.step, "seconds": round(self.seconds, 3), "views": len(scores), **mean_scores(scores)}
        self.metrics.append(now)
        self.on_event(f"{self.seconds:7.1f} s  step {self.step:6d}  psnr {now['psnr']:6.2f}  ssim {now['ssim']:.4f}")
