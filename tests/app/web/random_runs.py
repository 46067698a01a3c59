"""Defines runs with random networks on views of the built-in scene, one for each kind of field that a page can draw."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import torch
from helpers import renderer_of, seeded

from voronerf import MLP, HashGridField, Layer, NeRF, OccupancyGrid, VoronoiDiagram, VoronoiRouter
from voronerf.app.run import Run
from voronerf.app.scenes import Scene, builtin_scene
from voronerf.nerf import Adam, Contraction, Perspective
from voronerf.nerf.fields import KiloNeRF
from voronerf.nerf.fields.radiance import RadianceField

BOX = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
AXES = torch.tensor([[1.0, 0, 0], [0.0, 0, 1], [0.0, 1, 0]])  # right, up, forward
SPHERE = Contraction(torch.tensor([0.1, 0.0, -0.1]), 0.7)
PERSPECTIVE = Perspective(torch.tensor([0.0, -3.0, 0.2]), AXES, 1.0, (0.8, 0.7))
SHARED = {"share": ["features"]}


def hash_grid(width, *, log2_entries=10, box=BOX, **options):
    """Returns a function that makes a field."""
    return lambda: HashGridField(width=width, log2_entries=log2_entries, box=box and tuple(map(tuple, box)), **options)


#: The (field, router options, contraction, spacing of the strata) of each kind.
KINDS = {
    "hash grid": (hash_grid(16, log2_entries=12), SHARED, None, "linear"),
    "a table for each cell": (hash_grid(8, depth=2, levels=3, level_features=4), {}, None, "linear"),
    "one feature a level": (hash_grid(6, levels=5, level_features=1, finest=64), SHARED, None, "linear"),
    "eight features": (
        hash_grid(6, levels=2, level_features=8, view_directions=False, box=None),
        SHARED,
        None,
        "linear",
    ),
    "nerf": (lambda: NeRF(width=18, depth=6, position_octaves=5), {}, None, "linear"),
    "kilonerf": (lambda: KiloNeRF(position_octaves=6), {}, None, "linear"),
    "ahead": (lambda: KiloNeRF(width=12, position_octaves=3), {}, PERSPECTIVE, "linear"),
    "a sphere": (hash_grid(16, log2_entries=12, box=SPHERE.cube.tolist()), SHARED, SPHERE, "disparity"),
}


class Rotated(torch.nn.Module):
    """A custom field with its own activations; the router traces it."""

    def __init__(self):
        super().__init__()
        self.first, self.last = torch.nn.Linear(6, 10), torch.nn.Linear(10, 4)

    def forward(self, positions, directions):
        raw = self.last(torch.nn.functional.silu(self.first(torch.cat([positions, directions], -1))))
        return torch.tanh(raw[:, :3]) * 0.5 + 0.5, torch.nn.functional.leaky_relu(raw[:, 3:], 0.0) * 4


class Branches(torch.nn.Module):
    """A traced field: a layer is read before and after its ReLU, and one column is broadcast to three."""

    def __init__(self):
        super().__init__()
        self.first, self.last = torch.nn.Linear(6, 7), torch.nn.Linear(7, 5)

    def forward(self, positions, directions):
        layer = self.first(torch.cat([positions, directions], -1))
        raw = self.last(torch.relu(layer) * 3 - layer)
        return (raw[:, :3] * raw[:, 3:4]).sigmoid(), 4 * torch.nn.functional.softplus(raw[:, 4], beta=2)


class Spherical(RadianceField):
    """A layer table with spherical harmonics of the directions."""

    view_directions, density_scale = True, 6.0

    def __init__(self):
        super().__init__()
        layers = Layer(("positions",), 9, "softplus"), Layer((0,), 1), Layer((0, "directions"), 3)
        self.layers = MLP(layers, (2, 1), position_octaves=3, direction_encoding="spherical", direction_degree=4)
        self.parts = torch.nn.ModuleList(torch.nn.Linear(i, o) for o, i in self.layers.weight_shapes(3, 3))

    def linears(self):
        return list(self.parts)


KINDS["spherical harmonics"] = (Spherical, {}, None, "linear")
KINDS["traced"] = (Rotated, {"fuse": True, "coords": "first3"}, None, "linear")
KINDS["branches"] = (Branches, {"fuse": True, "coords": "first3"}, None, "linear")


@functools.cache
def views() -> Scene:
    """Returns the built-in scene; tests must not change it."""
    return builtin_scene(40, train_views=9, test_views=5)


def random_run(kind: str) -> Run:
    """Returns a run with nested cells of random networks in a random occupancy grid."""
    make, options, contraction, spacing = KINDS[kind]
    torch.manual_seed(4)
    field = make()
    first = VoronoiDiagram(torch.rand(3, 3, generator=seeded()) - 0.5)
    router = VoronoiRouter(field, first.centres, **options)
    points = torch.rand(500, 3, generator=seeded()) * 1.6 - 0.8
    optimizer = Adam(router.parameters(), lr=0.1)  # otherwise all live objects are searched
    router.subdivide(3, points=points, weights=torch.ones(500), optimizer=optimizer)
    assert router.diagram.depth == 2 and router.num_cells > 4
    with torch.no_grad():
        for parameter in router.parameters():
            wide = 2.0 if parameter.shape[-2:] == getattr(field, "features", torch.zeros(0, 0)).shape else 0.4
            parameter.copy_(wide * torch.randn(parameter.shape))
    scene = replace(views(), contraction=contraction)
    box = scene.box if contraction is None else contraction.cube
    scene = scene if contraction is None else replace(scene, box=None, near=0.4, far=40.0)
    grid = OccupancyGrid(box, (9, 8, 11), threshold=1.0, contraction=contraction)
    grid.occupied.copy_(torch.rand(9, 8, 11, generator=seeded()) < 0.3)
    settings = {"samples": 40, "picture_samples": 70, "occupancy": grid, "contraction": contraction, "spacing": spacing}
    space = SimpleNamespace(budget=1)
    return Run(Path("unused"), space, scene, router, renderer_of({"field": router}, **settings))
