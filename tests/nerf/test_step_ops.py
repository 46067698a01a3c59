"""Tests that a training step only calls ops, and pointwise operations of torch, which replays can repeat."""

import pytest
import torch
from helpers import refuses, seeded
from torch.utils._python_dispatch import TorchDispatchMode

from voronerf import HashGridField, VoronoiRouter
from voronerf.nerf import (
    Contraction,
    Occupancy,
    OccupancyGrid,
    PlannedSplit,
    RayBatches,
    RayLoss,
    Renderer,
    SmoothDepth,
    Space,
    SparseDepth,
    SplitStrategy,
    orbit_cameras,
)
from voronerf.nerf.samplers import SETTLING_STEPS
from voronerf.nerf.schedule import GROUP

SEEDS_MEMORY_VIEWS = {
    *("randint", "empty", "new_empty", "new_zeros", "view", "unsqueeze", "expand", "select", "slice", "detach"),
    *("alias", "split_with_sizes", "promote_types", "_local_scalar_dense"),
}


class Calls(TorchDispatchMode):
    """A mode that collects the names of torch's operations, except pointwise ones."""

    def __init__(self):
        super().__init__()
        self.names = set()

    def __torch_dispatch__(self, function, types, arguments=(), named=None):
        if function.namespace != "voronerf" and torch.Tag.pointwise not in function.tags:
            self.names.add(function.name().partition("::")[2].partition(".")[0])
        return function(*arguments, **(named or {}))


@pytest.mark.native
@pytest.mark.parametrize("contracted", [False, True])
def test_a_step_computes_in_ops_alone(contracted):
    """The step scales gradients near cameras, has sparse points, unseen rays and empty voxels, and evaluates voxels."""
    cameras = orbit_cameras(4, radius=2.0, elevation=10.0, width=20, height=20, focal=22.0)
    images = torch.randint(255, (4, 20, 20, 3), dtype=torch.uint8)
    sparse = torch.randint(1600, (50,)), torch.rand(50) + 1
    batches = RayBatches(
        cameras, images, near=0.2, far=9.0, background=torch.ones(3), sparse=sparse, unseen=0.5 * contracted
    )
    field = HashGridField(width=8, log2_entries=10)
    router = VoronoiRouter(field, torch.rand(4, 3), **field.router_options)
    contraction, box = Contraction(torch.zeros(3), 1.0), torch.tensor([[-1.0] * 3, [1.0] * 3])
    contraction = contraction if contracted else None
    grid = OccupancyGrid.for_training(None if contracted else box, 32, contraction=contraction, resolution=16)
    grid.settled = 0
    space, empty = Space(contraction=contraction, full_gradient=1.0), torch.rand(16**3) < 0.2
    sampler, random = Occupancy(grid, 32, space=space, empty=empty), seeded(0)
    loss = RayLoss(Renderer({"field": router}, sampler), terms=[SparseDepth(0.003), SmoothDepth(0.1)])
    strategy = SplitStrategy({"field": router}, [PlannedSplit(at=0.5, children=4)], reservoir=100, batches=10)

    def step(number):
        sampler.step_pre_backward(router, number, random)
        output = loss(batches.draw(64, random), random, backward=True)
        sampler.step_post_backward(output)
        strategy.step_post_backward(output)
        return output

    step(SETTLING_STEPS)  # a warm-up step
    with Calls() as calls:
        output = step(SETTLING_STEPS + GROUP)
    assert len(output.weights) and len(strategy.reservoir) and not bool(sampler.grid.occupied.flatten()[empty].any())
    assert calls.names <= SEEDS_MEMORY_VIEWS, calls.names - SEEDS_MEMORY_VIEWS


def test_a_limit_of_cells_needs_the_worst_cell():
    refuses("PlannedSplit: max_cells needs cells='worst', got cells='all' and 8", PlannedSplit, 1, 4, max_cells=8)
