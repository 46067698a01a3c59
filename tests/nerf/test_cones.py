"""Tests of cones: the radii of pixels, and the Gaussians of frustums, against random points and exact formulas."""

import math

import pytest
import torch
from helpers import refuses, seeded

from voronerf.nerf import Contraction, Perspective, Rays, orbit_cameras
from voronerf.nerf.cones import frustum_gaussians, frustum_moments

WIDE = torch.float64
ORBIT = {"radius": 2.0, "elevation": 20.0, "width": 4, "height": 4, "focal": 4.0}


def cone_points(edges, radius, count):
    """Draws uniform points in a conical frustum, [count, 3]: one coordinate along the axis and two across it."""
    generator = seeded(0)
    u = torch.rand(count, 3, generator=generator, dtype=WIDE)
    near, far = edges
    # The area of the disc at distance t is proportional to t^2.
    t = (near**3 + u[:, 0] * (far**3 - near**3)) ** (1 / 3)
    off = radius * t * u[:, 1].sqrt()
    angle = 2 * math.pi * u[:, 2]
    return torch.stack((t, off * angle.cos(), off * angle.sin()), dim=1)


def test_moments_in_float32_of_thin_frustums():
    """The stable form keeps its digits where t1 - t0 is a thousandth of t0; the plain form loses all of them."""
    edges = torch.tensor([[4.0, 4.004, 4.008]])
    radii = torch.tensor([0.002])
    exact = frustum_moments(edges.to(WIDE), radii.to(WIDE))
    for got, expected in zip(frustum_moments(edges, radii), exact, strict=True):
        torch.testing.assert_close(got.to(WIDE), expected, rtol=2e-3, atol=0)


@pytest.mark.parametrize(("edges", "radius"), [((2.0, 3.5), 0.3), ((0.0, 1.0), 0.5), ((3.0, 3.2), 0.8)])
def test_gaussians_against_monte_carlo(edges, radius):
    axis = torch.nn.functional.normalize(torch.tensor([0.3, -0.8, 0.4], dtype=WIDE), dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(axis, torch.tensor([0.0, 0, 1], dtype=WIDE)), dim=0)
    origin = torch.tensor([1.0, -2, 0.5], dtype=WIDE)
    local = cone_points(edges, radius, 400_000)
    points = origin + local @ torch.stack((axis, side, torch.linalg.cross(axis, side)))
    rays = Rays(origin[None], axis[None], torch.tensor([radius], dtype=WIDE))
    gaussian = frustum_gaussians(rays, torch.tensor([edges], dtype=WIDE))[0, 0]
    # The error of the mean of 400,000 draws is well below a hundredth of the standard deviation.
    assert ((gaussian[:3] - points.mean(0)).abs() <= 0.01 * points.std(0)).all()
    torch.testing.assert_close(gaussian[3:], points.var(0), rtol=0.02, atol=0)
    mean, along, across = frustum_moments(torch.tensor([edges], dtype=WIDE), rays.radii)
    expected = torch.stack([local[:, 0].mean(), local[:, 0].var(), local[:, 1].var()])
    torch.testing.assert_close(torch.cat((mean, along, across)).flatten(), expected, rtol=0.02, atol=0)


def test_radii_are_those_of_pixels():
    cameras = orbit_cameras(3, radius=4.0, elevation=20, width=80, height=60, focal=90.0)
    x, y = torch.tensor([40, 3, 79]), torch.tensor([30, 58, 0])
    rays = cameras.rays(1, x, y, cones=True)
    beside = cameras.rays(1, x + 1, y)
    assert rays.radii is not None and cameras.rays(1, x, y).radii is None
    # Pixels are 1 / focal wide on the image plane at depth 1, which rays reach at a distance of at least 1.
    forward = cameras.forward[1]
    at_plane = [r.directions / (r.directions @ forward)[:, None] for r in (rays, beside)]
    width = (at_plane[0] - at_plane[1]).norm(dim=1)
    torch.testing.assert_close(width, torch.full((3,), 1 / 90.0), rtol=1e-3, atol=0)
    torch.testing.assert_close(rays.radii, width * (rays.directions @ forward) * 2 / math.sqrt(12), rtol=1e-3, atol=0)
    indexed = cameras.rays(torch.ones(3, dtype=torch.int64), x, y, cones=True)
    torch.testing.assert_close(indexed.radii, rays.radii)
    part, moved = rays[torch.tensor([2, 0])], rays.to("cpu")
    assert part.radii is not None and moved.radii is not None and torch.equal(part.radii, rays.radii[[2, 0]])
    assert cameras.image_rays(0, cones=True).radii is not None


def test_rays_without_radii_are_no_cones():
    rays = Rays(torch.zeros(1, 3), torch.ones(1, 3))
    refuses("rays must have radii, got none", frustum_gaussians, rays, torch.tensor([[1.0, 2.0]]))


def test_an_empty_frustum_is_a_point():
    rays = Rays(torch.zeros(2, 3), torch.eye(3)[:2], torch.full((2,), 0.1))
    gaussians = frustum_gaussians(rays, torch.tensor([[0.0, 0.0], [3.0, 3.0]]))
    assert gaussians.isfinite().all() and not gaussians[0].any()
    assert gaussians[1, 0, :3].tolist() == [0, 3, 0] and gaussians[1, 0, 4] == 0


def slow_contract(x, centre, radius):
    y = (x - centre) / radius
    length = float(y.norm())
    return x if length <= 1 else centre + radius * (2 - 1 / length) * y / length


def test_contraction_against_the_formula():
    space = Contraction(torch.tensor([0.5, -1, 2], dtype=WIDE), 1.5)
    points = 6 * torch.randn(200, 3, generator=seeded(1), dtype=WIDE)
    points[0] = space.centre
    expected = torch.stack([slow_contract(x, space.centre, 1.5) for x in points])
    torch.testing.assert_close(space.points(points), expected)
    assert float((space.points(1e6 * points[1:]) - space.centre).norm(dim=1).max()) <= 3
    inside = (points - space.centre).norm(dim=1) < 1.5
    assert 1 < int(inside.sum()) < 200


@pytest.mark.parametrize(
    "space",
    [
        Contraction(torch.tensor([0.2, 0, -0.1], dtype=WIDE), 1.2),
        Perspective(torch.tensor([0.2, 0, -9.1], dtype=WIDE), torch.eye(3, dtype=WIDE)[[1, 0, 2]], 0.5, (0.6, 0.8)),
    ],
)
def test_contracted_gaussians_against_the_jacobian(space):
    generator = seeded(2)
    means = 3 * torch.randn(40, 3, generator=generator, dtype=WIDE)
    means[0] = torch.tensor([0.2, 0, -0.1], dtype=WIDE)  # in the middle of the sphere
    d = torch.nn.functional.normalize(torch.randn(40, 3, generator=generator, dtype=WIDE), dim=1)
    along, across = torch.rand(2, 40, 1, generator=generator, dtype=WIDE)
    got_means, got = space.gaussians(means, d, along, across)
    torch.testing.assert_close(got_means, space.points(means))
    for i in range(40):
        jacobian = torch.autograd.functional.jacobian(lambda x: space.points(x[None])[0], means[i])
        outer = d[i][:, None] * d[i][None]
        covariance = along[i] * outer + across[i] * (torch.eye(3, dtype=WIDE) - outer)
        torch.testing.assert_close(got[i], (jacobian @ covariance @ jacobian.T).diagonal())


def test_contracted_cones_are_those_of_space_inside_of_the_sphere():
    cameras = orbit_cameras(1, radius=2.0, elevation=10, width=4, height=4, focal=8.0)
    rays, edges = cameras.image_rays(0, cones=True), torch.linspace(1.5, 2.5, 9).repeat(16, 1)
    plain = frustum_gaussians(rays, edges)
    torch.testing.assert_close(frustum_gaussians(rays, edges, Contraction(torch.zeros(3), 2.0)), plain)
    bent = frustum_gaussians(rays, edges, Contraction(torch.zeros(3), 0.5))
    assert float((bent[..., :3]).norm(dim=-1).max()) < 1


@pytest.mark.parametrize(("centre", "radius"), [(3, 0.0), (3, float("inf")), (3, float("nan")), (2, 1.0)])
def test_a_sphere_has_a_centre_and_a_radius(centre, radius):
    with pytest.raises(ValueError, match=r"centre must have shape \[3\] and radius be positive and finite, got "):
        Contraction(torch.zeros(centre), radius)


@pytest.mark.parametrize(
    "space",
    [
        Contraction(torch.tensor([0.1, -0.2, 0.3]), 0.7),
        Perspective(torch.tensor([0.5, 0.0, 1.0]), orbit_cameras(1, **ORBIT).poses[0, :3, :3].T, 0.8, (0.5, 0.4)),
    ],
)
def test_contractions_can_be_undone(space):
    points = torch.rand(50, 3, generator=seeded(1)) * 8 - torch.tensor([4.0, 4.0, -1.0])
    if isinstance(space, Perspective):  # the space maps no point closer than half its near plane
        points = points @ space.axes + space.centre
    torch.testing.assert_close(space.inverse(space.points(points)), points, rtol=1e-3, atol=1e-4)
