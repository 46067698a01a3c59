"""A small training to compare replayed steps with eager steps."""

import torch

from voronerf import HashGridField, OccupancyGrid, VoronoiRouter
from voronerf.nerf import (
    Adam,
    DirectionPerSample,
    Occupancy,
    RayBatches,
    RayLoss,
    Renderer,
    SmoothDepth,
    SparseDepth,
    Surface,
    TrainingStep,
    orbit_cameras,
)
from voronerf.ops import Guard
from voronerf.ops._core.active import active

BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


class Scaled(torch.nn.Module):
    """A custom field with an attribute that the tests change."""

    def __init__(self):
        super().__init__()
        self.layer, self.scale = torch.nn.Linear(3, 4), 1.0

    def forward(self, positions, directions):
        raw = self.layer(positions)
        return raw[:, :3].sigmoid(), self.scale * torch.nn.functional.softplus(raw[:, 3])


class Training:
    """A small training whose occupancy grid is partly empty, so that its numbers of samples vary.

    With ``photograph`` it has points of a sparse model and rays from unseen views.
    """

    def __init__(self, cells=1, field=None, sampler=Occupancy, photograph=False, **options):
        torch.manual_seed(0)
        cameras = orbit_cameras(3, radius=3.0, elevation=0.3, width=16, height=16, focal=16.0)
        images = torch.randint(256, (3, 16, 16, 3), dtype=torch.uint8)
        points = torch.arange(0, 768, 7), torch.full((110,), 3.0)
        where = {"unseen": 0.5, "sparse": points} if photograph else {"box": BOX}
        self.batches = RayBatches(cameras, images, near=1.0, far=5.0, background=torch.ones(3), **where)
        own, field = field, field() if field else HashGridField(levels=4, log2_entries=10, width=16)
        share = ["features"] if isinstance(field, HashGridField) else []
        options = {"share": share, **options}
        self.router = VoronoiRouter(field, torch.rand(cells, 3) - 0.5, coords="first3", **options)
        grid = OccupancyGrid.for_training(BOX, 32, resolution=16)
        grid.density[:6] = grid.occupied[:6] = 0
        grid.settled = 0  # random images teach the field nothing
        self.sampler = sampler(grid, 32)
        shown = self.router if own is None else DirectionPerSample(self.router)
        terms = [SparseDepth(0.3), SmoothDepth(0.1), Surface(distortion=0.1, orientation=0.2)]
        self.loss = RayLoss(Renderer({"field": shown}, self.sampler), terms=terms)
        self.optimizer = Adam.of({"field": self.router}, lr=0.01, sparse=["features"])
        for group in self.optimizer.param_groups:
            group["betas"] = list(group["betas"])  # a list can be changed in place
        self.guard, self.generator = Guard.on("cpu"), torch.Generator().manual_seed(1)
        given = {"guard": self.guard, "generator": self.generator}
        self.step = TrainingStep(self.batches, self.loss, self.optimizer, **given)
        self.recorded = self.done = 0
        self.handles, self.other = [], None  # hook handles, and a second optimiser
        run = self.step._step._run

        def counted(*of):
            self.recorded += active.recording is not None
            return run(*of)

        self.step._step._run = counted

    def run_as_it_is(self):
        """Makes all further steps run eagerly."""
        self.step.forget()
        self.step._standing_obstacle = lambda: "a test"

    def train(self, steps, rays=lambda step: 64, as_it_is=False):
        """Runs steps, eagerly if ``as_it_is``; returns a flat list of their results."""
        results = []
        for step in range(steps):
            if as_it_is:
                self.run_as_it_is()
            self.optimizer.set_learning_rate(0.01 / (1 + step))
            result = self.step(rays(step))
            output = result.output
            kept = result.loss, output.weights, output.samples.ray_index, output.colour, result.batch.target
            results += [*(tensor.clone() for tensor in kept), torch.tensor([result.rays, result.samples])]
        return results

    def everything(self):
        moments = [value for state in self.optimizer.state.values() for value in state.values()]
        grid = self.sampler.grid
        gradients = [p.grad for p in self.router.parameters()]
        return [*self.router.parameters(), *gradients, *moments, grid.density, grid.occupied, *self.guard[:3]]


def same(one, other):
    return len(one) == len(other) and all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
