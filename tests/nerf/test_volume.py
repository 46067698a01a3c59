"""Tests of volume rendering, against slow loops and known integrals."""

import math

import pytest
import torch
from helpers import render_image, renderer_of, seeded

from voronerf.nerf import Batch, OccupancyGrid, RayLoss, Space, SparseDepth, Stratified, render_rays
from voronerf.nerf.cameras import Rays, orbit_cameras

BOX = torch.tensor([[-0.7, -0.7, -0.7], [0.7, 0.7, 0.7]])
WHITE = torch.ones(3)
#: For points at 2.0 and 2.9: the number of samples in front of the nearby samples, and the number of nearby samples. A
#: ray has 8 samples from 1 to 3.
ENDS = ((3, 2), (6, 2))


def ball(positions, directions, ray_index):
    """Returns colour (by position and ray direction) and density of a dense ball of radius 0.6."""
    rgb = 0.5 + 0.4 * positions * directions[ray_index.long()]
    return rgb, torch.where(positions.norm(dim=-1) < 0.6, 30.0, 0.0)


def rays(count=9):
    generator = seeded(0)
    origins = torch.tensor((0.0, 0.0, 3.0)).repeat(count, 1)
    targets = torch.randn(count, 3, generator=generator) * 0.4
    return Rays(origins, torch.nn.functional.normalize(targets - origins, dim=-1))


def cameras():
    return orbit_cameras(2, radius=3, elevation=25, width=13, height=9, focal=9)


@pytest.mark.parametrize("spacing", ["linear", "disparity"])
def test_against_slow_loop(spacing):
    some, samples, near, far = rays(), 17, 1.5, 4.5
    result = render_rays(
        ball, some, near, far, samples=Stratified(samples, space=Space(spacing=spacing)), background=WHITE
    )
    weights, positions = (result.samples.by_ray(x) for x in (result.weights, result.samples.positions))

    def distance(fraction):
        if spacing == "linear":
            return near + fraction * (far - near)
        return 1 / ((1 - fraction) / near + fraction / far)

    for r in range(len(some)):
        light, colour, opacity, depth = 1.0, [0.0] * 3, 0.0, 0.0
        for s in range(samples):
            t = distance((s + 0.5) / samples)
            delta = distance((s + 1) / samples) - distance(s / samples)
            point = [float(some.origins[r, i]) + t * float(some.directions[r, i]) for i in range(3)]
            sigma = 30.0 if math.sqrt(sum(x * x for x in point)) < 0.6 else 0.0
            weight = light * (1 - math.exp(-sigma * delta))
            light *= math.exp(-sigma * delta)
            for i in range(3):
                colour[i] += weight * (0.5 + 0.4 * point[i] * float(some.directions[r, i]))
            opacity += weight
            depth += weight * t
            assert float(weights[r, s]) == pytest.approx(weight, abs=1e-5)
            assert positions[r, s].tolist() == pytest.approx(point, abs=1e-5)
        assert result.colour[r].tolist() == pytest.approx([c + 1 - opacity for c in colour], abs=1e-5)
        assert float(result.opacity[r]) == pytest.approx(opacity, abs=1e-5)
        assert float(result.depth[r]) == pytest.approx(depth / opacity if opacity > 1e-7 else far, abs=1e-4)


def test_rays_of_no_extent_show_the_background():
    ends, background = (torch.tensor([2.0, 2.0]), torch.tensor([2.0, 4.0])), torch.tensor((0.1, 0.2, 0.3))
    result = render_rays(ball, rays(2), *ends, samples=32, background=background)
    torch.testing.assert_close(result.colour[0], background)
    assert float(result.opacity[0]) == 0 and float(result.depth[0]) == 2
    assert float(result.opacity[1]) > 0.9


def test_gradients_reach_density_and_colour_and_not_nan_on_empty_rays():
    colour = torch.full((3,), 0.5, requires_grad=True)
    density = torch.tensor(0.0, requires_grad=True)

    def learned(positions, directions, ray_index):
        return colour.expand_as(positions), density.expand(len(positions))

    result = render_rays(learned, rays(2), 1.0, 2.0, samples=4, background=WHITE)
    (result.colour.sum() + result.depth.sum()).backward()
    assert density.grad is not None and density.grad.isfinite() and float(density.grad) != 0
    assert colour.grad is not None and colour.grad.isfinite().all()


def test_a_half_precision_field_is_summed_in_float32():
    def half(positions, directions, ray_index):
        rgb, sigma = ball(positions, directions, ray_index)
        return rgb.bfloat16(), sigma.bfloat16()

    result = render_rays(half, rays(), 1.5, 4.5, samples=16)
    assert result.colour.dtype == torch.float32
    torch.testing.assert_close(result.colour, render_rays(ball, rays(), 1.5, 4.5, samples=16).colour, atol=5e-3, rtol=0)


@pytest.mark.parametrize("marched", [False, True])
def test_what_is_near_the_camera_learns_less(marched):
    """Gradients grow with the square of the distance, up to the distance of full gradients."""
    ahead = Rays(torch.zeros(1, 3), torch.tensor([[0.0, 0, 1]]))
    grid = OccupancyGrid(torch.tensor([[-9.0] * 3, [9.0] * 3]), 4, threshold=0.1) if marched else None
    results = []
    for full in (None, 2.0):
        answers = torch.full((8, 4), 0.3, requires_grad=True)
        fog = lambda *_, answers=answers: (answers[:, :3], answers[:, 3])  # noqa: E731
        renderer = renderer_of({"field": fog}, samples=8, occupancy=grid, full_gradient=full)
        (rendered,) = renderer.render(ahead, 1.0, 3.0)
        rendered.colour.sum().backward()
        results.append(answers.grad)
    depths = 1.125 + 0.25 * torch.arange(8)
    torch.testing.assert_close(results[1], results[0] * (depths / 2).square().clamp(max=1)[:, None])


def test_the_last_rays_end_at_points():
    """The loss is minus the log of the sum of the weights near a point.

    A sample is near if its distance from the point is at most 3 % of the point's depth, plus the sample's length, 0.25.
    """
    ahead = Rays(torch.zeros(3, 3), torch.tensor([[0.0, 0, 1]]).expand(3, 3))
    fog = lambda positions, *_: (torch.zeros_like(positions), torch.full_like(positions[:, 0], 0.5))  # noqa: E731
    renderer = renderer_of({"field": fog}, samples=8)
    rendered, ends = render_rays(fog, ahead, 1.0, 3.0, samples=8), (torch.ones(3), torch.full((3,), 3.0))
    renderer.sampler.sample = lambda *_, **__: rendered.samples  # without jitter
    expected = 0.1 * sum(-math.log(math.exp(-0.125 * before) * (1 - math.exp(-0.125 * many))) for before, many in ENDS)
    target, seen = rendered.colour, torch.tensor([2.0, 2.9])
    loss = RayLoss(renderer, terms=[SparseDepth(0.1)])
    assert float(loss(Batch(ahead, *ends, target, None, seen)).loss) == pytest.approx(expected / 2, rel=1e-5)
    assert float(loss(Batch(ahead, *ends, target)).loss) == 0


def test_image_is_the_rays_of_its_pixels_whatever_the_chunk():
    some = cameras()
    options = {"near": 1.0, "far": 5.0, "samples": 24, "background": WHITE}
    image = render_image(ball, some, 1, **options)
    assert image.colour.shape == (9, 13, 3) and image.opacity.shape == image.depth.shape == (9, 13)
    direct = render_rays(ball, some.image_rays(1), 1.0, 5.0, samples=24, background=WHITE)
    torch.testing.assert_close(image.colour.reshape(-1, 3), direct.colour)
    torch.testing.assert_close(image.depth.reshape(-1), direct.depth)
    chunked = render_image(ball, some, 1, chunk=7, **options)
    for one, other in zip(image, chunked):
        torch.testing.assert_close(one, other)
    weights, positions = (direct.samples.by_ray(x) for x in (direct.weights, direct.samples.positions))
    top = weights.argmax(-1)
    seen = direct.opacity > 0.5
    torch.testing.assert_close(image.heaviest.reshape(-1, 3)[seen], positions[torch.arange(len(top)), top][seen])


def test_rays_that_miss_the_box_do_not_ask_the_field():
    asked = []

    def counting(positions, directions, ray_index):
        asked.append(len(directions))
        assert (positions.abs() <= 0.7 + 1e-4).all()
        return ball(positions, directions, ray_index)

    some = cameras()
    image = render_image(counting, some, 0, near=1.0, far=5.0, box=BOX, samples=64, background=WHITE)
    open_space = render_image(ball, some, 0, near=1.0, far=5.0, samples=400, background=WHITE)
    assert 0 < sum(asked) < 9 * 13
    missed = image.opacity == 0
    assert torch.equal(image.colour[missed], torch.ones(int(missed.sum()), 3))
    assert image.heaviest.isfinite().all()
    assert float((image.colour - open_space.colour).abs().mean()) < 0.01
    nothing = render_image(counting, some, 0, near=1.0, far=5.0, box=BOX + 50, samples=4)
    assert float(nothing.colour.abs().max()) == 0 and float(nothing.depth.min()) == 5.0


def test_no_rays():
    result = render_rays(ball, Rays(torch.zeros(0, 3), torch.zeros(0, 3)), 1.0, 2.0, samples=3)
    assert result.colour.shape == (0, 3) and result.weights.shape == (0,)
