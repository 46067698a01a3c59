"""Tests of fields with a known program: the fast step and images equal separate operations."""

import math
import re
from dataclasses import replace
from typing import ClassVar

import pytest
import torch
import torch.nn.functional as F
from helpers import renderer_of, seeded
from torch import nn

from voronerf import MLP, HashGridField, Layer, NeRF, OccupancyGrid, VoronoiRouter
from voronerf.nerf import Batch, DirectionPerSample, RayLoss, Rays, SmoothDepth, SparseDepth, Surface
from voronerf.nerf.fields.nerf import MipNeRF
from voronerf.nerf.fields.radiance import RadianceField
from voronerf.nerf.occupancy import density_of
from voronerf.nerf.radiance import Radiance, radiance_of
from voronerf.ops.composite.reference import ray_spans
from voronerf.ops.ray_losses.reference import smooth_depth, sparse_depth, surface
from voronerf.ops.render_loss.reference import robust_error

pytestmark = pytest.mark.native
BOX = torch.tensor([[-1.0] * 3, [1.0] * 3])


def encoded(x, octaves):
    x = x * torch.tensor([1.0, 1.5, 0.5])
    parts = [x]
    for octave in range(octaves):
        parts += [torch.sin(2**octave * x), torch.cos(2**octave * x)]
    return torch.cat(parts, -1)


class Foreign(nn.Module):
    """A field in the style of other codebases."""

    activations: ClassVar = {
        "softplus": lambda self, x: F.softplus(x) * self.scale,
        "beta": lambda self, x: F.softplus(x, beta=3.0),
        "relu": lambda self, x: F.relu(x + 0.5),
        "exp": lambda self, x: torch.exp(x - 1),
    }

    def __init__(self, density="softplus", keepdim=False):
        super().__init__()
        self.trunk = nn.ModuleList([nn.Linear(27, 16), nn.Linear(16 + 27, 16)])
        self.density, self.view, self.colour = nn.Linear(16, 1), nn.Linear(16 + 15, 12), nn.Linear(12, 3)
        self.kind, self.keepdim, self.scale = density, keepdim, 4.0

    def forward(self, positions, directions):
        x = encoded(positions, 4)
        h = F.relu(self.trunk[0](x))
        h = F.relu(self.trunk[1](torch.cat([h, x], -1)))
        raw = self.density(h)
        raw = raw if self.keepdim else raw.squeeze(-1)
        colour = self.colour(F.relu(self.view(torch.cat([h, encoded(directions, 2)], -1))))
        return torch.sigmoid(colour), self.activations[self.kind](self, raw)


class Own(RadianceField):
    """A field with a layer table and its own activations."""

    def __init__(self):
        super().__init__()
        self.layers = MLP((Layer(("positions",), 16, "relu"), Layer((0,), 4)), (1,), position_octaves=3)
        self.first, self.second, self.view_directions = nn.Linear(21, 16), nn.Linear(16, 4), False

    def linears(self):
        return [self.first, self.second]

    def activate(self, raw):
        return (raw[:, :3].tanh() + 1) / 2, F.relu(raw[:, 3] + 1)


FIELDS = {
    "softplus": (lambda: Foreign(), {"fuse": True}),
    "beta": (lambda: Foreign("beta"), {"fuse": True}),
    "relu": (lambda: Foreign("relu", keepdim=True), {"fuse": True}),
    "exp": (lambda: Foreign("exp"), {"fuse": True}),
    "one shared": (lambda: Foreign("exp"), {"fuse": True, "share": ["trunk.*", "view.bias"]}),
    "hash": (lambda: HashGridField(width=16, levels=2, log2_entries=10), {"share": ["features"]}),
    "table": (lambda: NeRF(width=16, depth=2), {}),
    "own table": (Own, {}),
}
RAW = ("softplus", "hash", "table")


def make(name, k=4, **options):
    torch.manual_seed(0)
    module, own = FIELDS[name]
    router = VoronoiRouter(module(), torch.rand(k, 3) - 0.5, coords="first3", **own, **options)
    for p in router.parameters():
        if p.dim() > 1:
            p.data += 0.1 * torch.randn(p.shape)
    return router, DirectionPerSample(router) if isinstance(router.module, Foreign) else router


def batch_of(rays=64, sparse=0, unseen=0):
    generator = seeded(1)
    directions = F.normalize(torch.randn(rays, 3, generator=generator), dim=-1)
    origins = -2.0 * directions + 0.2 * torch.randn(rays, 3, generator=generator)
    ends = torch.full((rays,), 0.5), torch.full((rays,), 3.5)
    depths = 0.6 + 2.8 * torch.rand(sparse, generator=generator) if sparse else None
    target = torch.rand(rays, 3, generator=generator)
    return Batch(Rays(origins, directions), *ends, target, torch.ones(3), depths, unseen)


def losses(field, monkeypatch, backend="auto", full_gradient=None, **terms):
    """Returns two losses, with the fast step and with separate operations; both differentiate all samples."""
    monkeypatch.setattr("voronerf.nerf.loss.HIDDEN", 0.0)
    grid = OccupancyGrid(BOX, 8, threshold=0.1)
    grid.occupied = torch.rand(8, 8, 8, generator=seeded(5)) < 0.7
    options = {"samples": 24, "occupancy": grid, "backend": backend, "full_gradient": full_gradient}
    fast, separate = (
        RayLoss(renderer_of({"field": of}, **options), **terms) for of in (field, lambda *arguments: field(*arguments))
    )
    return fast, separate


def compare(router, fast, separate, batch):
    results, gradients = [], []
    for loss in (fast, separate):
        router.zero_grad()
        results.append(loss(batch, seeded(3), backward=True))
        gradients.append([None if p.grad is None else p.grad.clone() for p in router.parameters()])
    assert fast.why_not_fused() is None and separate.why_not_fused() is not None
    assert torch.equal(results[0].samples.positions, results[1].samples.positions)
    for part, other in zip(*([*of[:4], of.importance(), of.colour] for of in results), strict=True):
        torch.testing.assert_close(part, other, rtol=1e-4, atol=1e-5)
    for part, other in zip(*gradients, strict=True):
        assert part is not None and part.any()
        torch.testing.assert_close(part, other, rtol=2e-3, atol=1e-6 + 1e-4 * float(other.abs().max()))


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("k", [1, 4])
def test_the_fast_step_is_the_separate_one(name, k, monkeypatch):
    router, field = make(name, k)
    fast, separate = losses(field, monkeypatch)
    compare(router, fast, separate, batch_of())
    assert ("density_scale" in radiance_of(field).networks.activation) == (name in RAW)
    assert all(p.is_leaf for p in radiance_of(field).cells.parameters)


def term_of_all(seen, batch):
    """Returns a loss term that reads all results of the rays."""
    near = (seen.colour - batch.target).abs().mean() + (seen.depth / batch.far).mean()
    fog = (seen.density / (1 + seen.density) * seen.samples.deltas).mean() + (seen.rgb * seen.weights[:, None]).mean()
    return near + fog + seen.opacity.square().mean() + seen.weights.square().sum() / len(batch.rays)


@pytest.mark.parametrize("full_gradient", [None, 2.5])
@pytest.mark.parametrize("name", ["softplus", "relu", "hash", "table", "own table"])
def test_equals_a_rendering_that_torch_differentiates(name, full_gradient, monkeypatch):
    """The loss of colours and all kinds of terms equals the formulas of the references."""
    router, field = make(name)
    terms = [SparseDepth(0.3), term_of_all, SmoothDepth(0.2), Surface(distortion=0.4, orientation=0.3)]
    fast, separate = losses(field, monkeypatch, full_gradient=full_gradient, terms=terms, robust=0.05)
    batch, results = batch_of(sparse=20, unseen=12), []
    for loss in (fast, separate):
        router.zero_grad()
        results.append([loss(batch, seeded(3), backward=True).loss, *(p.grad.clone() for p in router.parameters())])
    router.zero_grad()
    arguments = {"background": batch.background, "jitter": True, "generator": seeded(3)}
    seen = separate.renderer.render(batch.rays, batch.near, batch.far, **arguments)[-1]
    samples = seen.samples
    weights, depths, deltas, offsets = seen.weights, samples.depths, samples.deltas, samples.ray_offsets
    error = (seen.colour - batch.target).square().sum(-1)[:28]
    expected = robust_error(error, 0.05).sum() / 192 + term_of_all(seen, batch)
    expected = expected + 0.3 * sparse_depth(weights, depths, deltas, offsets, batch.sparse_depths)
    expected = expected + 0.2 * smooth_depth(weights, depths, offsets, batch.far, 12)
    opacities, lit = -torch.expm1(-seen.density * deltas), torch.ones_like(seen.density, dtype=torch.bool)
    rays = ray_spans(offsets, len(weights)), lit, batch.near, batch.far
    expected = expected + surface(weights, opacities, depths, deltas, *rays, (0.4, 0.3))
    expected.backward()
    for own in results:
        for part, other in zip(own, [expected.detach(), *(p.grad for p in router.parameters())], strict=True):
            torch.testing.assert_close(part, other, rtol=2e-3, atol=1e-6 + 1e-4 * float(other.abs().max()))


@pytest.mark.parametrize(("term", "came"), [(lambda seen, batch: 0.5, "0.5"), (lambda seen, batch: seen.depth, "[64]")])
def test_a_term_that_gives_no_scalar_is_refused(term, came, monkeypatch):
    _, field = make("relu")
    for loss in losses(field, monkeypatch, terms=[term]):
        with pytest.raises(ValueError, match=f"RayLoss: a term must give a scalar tensor, got {re.escape(came)}"):
            loss(batch_of())


def test_colours_that_would_learn_are_refused(monkeypatch):
    _, field = make("relu")
    for loss in losses(field, monkeypatch):
        batch = replace(batch_of(), background=torch.ones(3, requires_grad=True))
        with pytest.raises(ValueError, match="RayLoss: background must not require a gradient"):
            loss(batch)


def test_a_term_that_reads_nothing_adds_to_the_loss_alone(monkeypatch):
    _, field = make("relu")
    with_it, without = (
        losses(field, monkeypatch, terms=terms)[0](batch_of(), seeded(3)) for terms in ([lambda *_: torch.ones(())], [])
    )
    torch.testing.assert_close(with_it.loss, without.loss + 1)


@pytest.mark.parametrize("name", ["relu", "hash"])
def test_with_rays_from_where_no_camera_was(name, monkeypatch):
    """The loss reads the depths of rays without a camera, but not their colours."""
    fast, _ = losses(make(name)[1], monkeypatch, terms=[SmoothDepth(0.3), SparseDepth(0.3)], robust=0.05)
    batch = batch_of(sparse=20, unseen=12)
    result = fast(batch, seeded(3))
    batch.target[28:] = 7.0
    torch.testing.assert_close(fast(batch, seeded(3)).loss, result.loss, rtol=1e-4, atol=0)
    assert bool(result.error[:28].all()) and not bool(result.error[28:].any())


@pytest.mark.parametrize("name", ["relu", "one shared", "hash"])
def test_frozen_cells_learn_nothing(name, monkeypatch):
    router, field = make(name)
    router.freeze([1, 3])
    compare(router, *losses(field, monkeypatch), batch_of())
    assert not router.module.density.weight.grad[[1, 3]].any()


@pytest.mark.parametrize("name", ["softplus", "exp", "hash"])
def test_in_a_nested_diagram(name, monkeypatch):
    router, field = make(name, 2)
    points = torch.rand(500, 3) - 0.5
    router.subdivide(3, points=points, weights=torch.ones(500))
    assert router.diagram.depth == 2 and router.num_cells > 2
    compare(router, *losses(field, monkeypatch), batch_of())


def test_with_cells_that_are_drawn():
    router, field = make("exp", assignment="stochastic", temperature=0.2)
    results = []
    for _ in range(2):
        router.generator = seeded(7)
        known = radiance_of(field, (torch.rand(20, 3), torch.rand(20, 3)))
        rows = known.rows(torch.rand(50, 3, generator=seeded(1)), torch.rand(4, 3), None)
        results.append(rows["cells"].cells)
    router.generator = seeded(7)
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], router.assign(torch.rand(50, 3, generator=seeded(1))))


def test_an_attribute_that_changes_is_followed(monkeypatch):
    router, field = make("softplus")
    fast, separate = losses(field, monkeypatch)
    for scale in (4.0, 8.0, 1.5):
        router.module.scale = scale
        compare(router, fast, separate, batch_of())
    table, field = make("table")
    fast, separate = losses(field, monkeypatch)
    for scale in (10.0, 3.0):
        table.module.density_scale = scale
        compare(table, fast, separate, batch_of())
        assert radiance_of(field).networks.activation.get("density_scale") == scale


def test_parameters_that_parameters_are_made_of_learn(monkeypatch):
    class Scaled(Foreign):
        def __init__(self):
            super().__init__("exp")
            self.gain = nn.Parameter(torch.rand(16, 1) + 0.5)

        def forward(self, positions, directions):
            x = encoded(positions, 4)
            h = F.relu(F.linear(x, self.trunk[0].weight * self.gain, self.trunk[0].bias))
            h = F.relu(self.trunk[1](torch.cat([h, x], -1)))
            colour = self.colour(F.relu(self.view(torch.cat([h, encoded(directions, 2)], -1))))
            return torch.sigmoid(colour), torch.exp(self.density(h)[:, 0] - 1)

    monkeypatch.setitem(FIELDS, "scaled", (Scaled, {"fuse": True}))
    router, field = make("scaled")
    compare(router, *losses(field, monkeypatch), batch_of())
    assert router.module.gain.grad.any()


@pytest.mark.parametrize("name", FIELDS)
def test_pictures_and_densities_are_those_of_the_field(name):
    _, field = make(name)
    field.eval()
    grid = OccupancyGrid(BOX, 8, threshold=0.1)
    batch, points = batch_of(100), torch.rand(60, 3, generator=seeded(2)) * 2 - 1
    seen, densities = [], []
    with torch.no_grad():
        for of in (field, lambda *arguments: field(*arguments)):
            renderer = renderer_of({"field": of}, samples=40, occupancy=grid)
            seen.append(renderer.render_colours(batch.rays, batch.near, batch.far, torch.ones(3)))
            densities.append(density_of(of, points))
    torch.testing.assert_close(*densities, rtol=1e-4, atol=1e-5)
    # An opaque ray ends after a wave (a few samples of each ray). The waves of the two renderings have different
    # lengths, so rays end with different amounts of remaining light.
    torch.testing.assert_close(seen[0].colour, seen[1].colour, rtol=0, atol=0.06)
    with torch.no_grad():
        assert isinstance(radiance_of(field), Radiance)


def test_what_keeps_a_field_from_the_fast_step():
    def why(field, first=True):
        grid = OccupancyGrid(BOX, 4, threshold=0.1)
        loss = RayLoss(renderer_of({"field": field}, samples=8, occupancy=grid))
        if first:
            loss(batch_of(), seeded(0), backward=True)
        return loss.why_not_fused()

    class Looked(Foreign):
        def forward(self, positions, directions):
            colour, density = super().forward(positions, directions)
            return colour, density + F.embedding(positions[:, 0].long().abs() % 2, self.colour.weight[:, :1])[:, 0]

    centres, arguments = torch.rand(3, 3), {"coords": "first3"}
    assert why(lambda *arguments: make("table")[1](*arguments)) == "the field is a function, not a VoronoiRouter"
    router, field = make("relu")
    assert why(field, first=False) == "Foreign.forward is traced at its first call"
    assert why(field) is None
    hook = router.module.trunk[0].register_forward_hook(lambda module, args, output: output + 1)
    assert why(field, first=False) == "Foreign.forward is traced at its next call"
    hook.remove()
    plain = DirectionPerSample(VoronoiRouter(Foreign(), centres, **arguments))
    assert why(plain) == "Foreign.forward is not traced without fuse=True"
    looked = why(DirectionPerSample(VoronoiRouter(Looked(), centres, **arguments, fuse=True)))
    assert looked.startswith("Looked.forward is not one program: ") and "between them" in looked
    moved = DirectionPerSample(VoronoiRouter(Foreign(), centres, fuse=True, coords=lambda x, d: x + 1))
    assert why(moved) == "positions other than the samples' decide the cells"
    shared = DirectionPerSample(VoronoiRouter(Foreign(), centres, **arguments, fuse=True, share=["*"]))
    assert why(shared) == "all cells share all parameters"
    table, field = make("table")
    table.module.view.register_forward_hook(lambda module, args, output: output)
    assert why(field) == "NeRF computes more than its program"
    cones = VoronoiRouter(MipNeRF(width=8, depth=1), centres)
    assert why(cones, first=False) == "the field takes 6 numbers per sample, got 3"


def test_explains_the_step_in_one_way(monkeypatch):
    for name in ("relu", "table", "own table"):
        _, field = make(name)
        fast, separate = losses(field, monkeypatch)
        fast(batch_of(), seeded(0), backward=True)
        lines = fast.explain().splitlines()
        assert lines[1:] == ["loss: networks, colours, loss and gradients in one operation, on the native backend"]
        assert separate.explain().splitlines()[1] == "loss: networks, colours and loss are separate operations"


@pytest.mark.parametrize("name", ["relu", "table", "own table"])
def test_on_every_backend(name, monkeypatch, device, backend):
    """Layers run on each backend (Warp kernels too), whatever activations follow."""
    if torch.device(device).type != "cpu":
        pytest.skip("the same as on the CPU")
    router, field = make(name, backend=backend if name != "relu" or backend != "warp" else "auto")
    fast, separate = losses(field, monkeypatch, backend=backend)
    compare(router, fast, separate, batch_of(16))


def test_softplus_is_that_of_the_loss():
    """A softplus of another threshold or slope is not fused; the field itself computes it."""
    for density, scale in (
        (lambda x: F.softplus(x), 1.0),
        (lambda x: 2.5 * F.softplus(x - 1.0), 2.5),
        (lambda x: F.softplus(x, threshold=5.0), None),
        (lambda x: F.softplus(x, beta=2.0), None),
        (lambda x: F.softplus(x) + 1.0, None),
        (lambda x: -2.0 * F.softplus(x), None),
    ):
        FIELDS["given"] = (Own, {})
        router, field = make("given")
        router.module.activate = lambda raw, density=density: (torch.sigmoid(raw[:, :3]), density(raw[:, 3]))
        assert radiance_of(field).networks.activation.get("density_scale") == scale
        del FIELDS["given"]
    assert math.isclose(
        radiance_of(make("softplus")[1], (torch.rand(9, 3),) * 2).networks.activation["density_scale"], 4.0
    )
