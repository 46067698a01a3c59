"""Tests that a user's samplers and split rules can replace the library's: no code checks for their class."""

from __future__ import annotations

import itertools

import pytest
import torch

from voronerf import NeRF, OccupancyGrid, VoronoiRouter
from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Checkpoints, TrainConfig, build, load, run, snapshot
from voronerf.nerf import Batch, Occupancy, RayLoss, Rays, Renderer, Sampler, Strategy


class Borrowed(Sampler):
    """A sampler that has a grid, but does not inherit from `Occupancy`."""

    def __init__(self, other):
        super().__init__(other.samples, space=other.space)
        self.other, self.seen = other, 0

    @property
    def grid(self):
        return self.other.grid

    def sample(self, rays, near, far, *, jitter=False, generator=None):
        return self.other.sample(rays, near, far, jitter=jitter, generator=generator)

    def render_colours(self, field, rays, near, far, **options):
        self.seen += 1
        return self.other.render_colours(field, rays, near, far, **options)


class Never(Strategy):
    """A split rule that counts the calls of its hook, and never splits."""

    def __init__(self):
        self.steps = 0

    def step_post_backward(self, output):
        self.steps += 1
        assert output.weights.shape == output.density.shape

    def state_dict(self):
        return {"steps": torch.tensor(self.steps)}

    def load_state_dict(self, state):
        self.steps = int(state["steps"])


@pytest.mark.native
def test_a_sampler_with_a_grid_is_fused_and_walks_pictures() -> None:
    torch.manual_seed(0)
    box = torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]])
    grid = OccupancyGrid(box, 8, threshold=0.1)
    grid.occupied[4:] = False
    occupancy = Occupancy(grid, 16)
    router = VoronoiRouter(NeRF(width=16, depth=2), torch.zeros(1, 3))
    rays = Rays(torch.tensor([[-0.5, 0, -2.0], [0.5, 0, -2]]), torch.tensor([[0.0, 0, 1], [0, 0, 1]]))
    batch = Batch(rays, torch.ones(2), torch.full((2,), 3.0), torch.rand(2, 3))
    losses = [RayLoss(Renderer({"field": router}, sampler)) for sampler in (occupancy, Borrowed(occupancy))]
    assert [loss.why_not_fused() for loss in losses] == [None, None]
    assert losses[1].explain().startswith("samples: Borrowed, 16 a ray\nloss: networks, colours, loss and gradients in")
    results = [loss(batch, torch.Generator().manual_seed(1)) for loss in losses]
    assert torch.equal(results[0].loss, results[1].loss) and 0 < len(results[0].weights) < 32
    pictures = [loss.renderer.render_colours(rays, batch.near, batch.far) for loss in losses]
    assert torch.equal(pictures[0].colour, pictures[1].colour) and losses[1].renderer.sampler.seen == 1
    assert losses[1].renderer.occupancy is grid


def test_the_heaviest_samples_of_rays_with_different_numbers_of_samples() -> None:
    """The picture of a sampler that only has ``sample`` names each ray's heaviest sample, or the ray's origin."""
    torch.manual_seed(0)

    class Packed(Borrowed):
        render_colours = Sampler.render_colours

    grid = OccupancyGrid(torch.tensor([[-1.0, -1, -1], [1.0, 1, 1]]), 8, threshold=0.1)
    grid.occupied[4:] = False
    renderer = Renderer({"field": NeRF(width=16, depth=2)}, Packed(Occupancy(grid, 16)))
    starts = torch.tensor([[-0.5, 0, -2.0], [0.5, 0, -2], [-0.3, 0.1, -1.5]])
    rays, near, far = Rays(starts, torch.tensor([[0.0, 0, 1]]).expand(3, 3)), torch.ones(3), torch.full((3,), 3.0)
    last = renderer.render(rays, near, far)[-1]
    ends = last.samples.ray_offsets.tolist()
    wanted = starts.clone()
    for ray, (begin, end) in enumerate(itertools.pairwise(ends)):
        if end > begin:
            wanted[ray] = last.samples.positions[begin + int(last.weights[begin:end].argmax())]
    assert len({end - begin for begin, end in itertools.pairwise(ends)}) == 3
    assert torch.equal(renderer.render_colours(rays, near, far).heaviest, wanted)


@pytest.mark.native
def test_a_training_asks_no_more_of_a_rule_than_strategy_names(tmp_path) -> None:
    scene, config = builtin_scene(16, train_views=4, test_views=2), TrainConfig(steps=12, cells=(), width=8, rays=64)
    state = build(config, scene)
    state.strategy = state.training_step.strategy = Never()
    run(state, [Checkpoints(tmp_path)])
    assert state.strategy.steps == state.step == 12 and state.strategy.remaining == 0
    again = build(config, scene)
    again.strategy = Never()
    load(again, snapshot(state))
    assert again.strategy.steps == 12
