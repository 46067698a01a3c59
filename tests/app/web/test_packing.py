"""Tests of a page's packed data, without a browser."""

from __future__ import annotations

import json
import re
import zlib
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from helpers import refuses, renderer_of
from random_runs import KINDS, random_run

from voronerf import NeRF, VoronoiRouter
from voronerf.app.web import CannotDraw, export_web, pack, page_of
from voronerf.app.web import packing as packing_file
from voronerf.app.web.page import wide_enough
from voronerf.app.web.shader import BLOCK, ParameterOffsets, fours, networks_text
from voronerf.nerf import Stratified, orbit_cameras
from voronerf.nerf.fields import MipNeRF
from voronerf.nerf.radiance import radiance_of
from voronerf.ops import locate_cell

HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(1)> {{script}} \u2028 '\""


class Page(HTMLParser):
    """A parser that collects a page's elements, and the texts of its scripts by id."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.texts, self.open = [], {}, None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open = dict(attrs).get("id", tag) if tag in ("script", "style", "title") else None

    def handle_endtag(self, tag):
        self.open = None

    def handle_data(self, data):
        if self.open:
            self.texts[self.open] = self.texts.get(self.open, "") + data


def part(packed, name, dtype):
    start, size = packed.scene["parts"][name]
    return np.frombuffer(packed.data[start : start + size], dtype)


@pytest.mark.parametrize("kind", KINDS)
def test_parameters_are_read_back_as_the_shader_reads_them(runs, kind):
    run = runs(kind)
    field, packed, layout = radiance_of(run.router, examples()), pack(run), ParameterOffsets()
    networks_text(field.networks, layout)
    values = part(packed, "parameters", "<f2").reshape(-1)[: run.diagram.num_cells * layout.size]
    values = values.reshape(run.diagram.num_cells, layout.size).astype(np.float64)
    parameters = [parameter.detach().numpy() for parameter in field.cells.parameters]
    read = set()
    for number, start, o, i, place in layout.matrices:
        for cell in (0, run.diagram.num_cells - 1):
            x, y = np.random.default_rng(cell).normal(size=4 * fours(i)), np.zeros(4 * fours(o))
            for row in range(fours(o)):
                for column in range(fours(i)):
                    at = place + (row * fours(i) + column) * BLOCK
                    block = values[cell, at : at + BLOCK].reshape(4, 4).T  # mat4x4f is column-major
                    y[4 * row : 4 * row + 4] += block @ x[4 * column : 4 * column + 4]
            wanted = parameters[number][cell][:, start : start + i] @ x[:i]
            assert np.abs(y[:o] - wanted).max() < 2e-3 * (1 + np.abs(wanted).max()) and not y[o:].any()
        read.add(number)
    for number, start, width, place in layout.vectors:
        wanted = parameters[number].reshape(len(values), -1)[:, start : start + width]
        assert np.abs(values[:, place : place + width] - wanted).max() < 1e-2
        read.add(number)
    tables = field.networks.program.tables
    assert read | set(tables) == set(range(len(parameters)))
    for table in tables:
        assert np.array_equal(part(packed, "table", "<f2"), parameters[table].astype("<f2").reshape(-1))


def examples():
    return torch.rand(16, 3), torch.nn.functional.normalize(torch.rand(16, 3), dim=-1)


def test_grid_cells_and_cameras_are_read_back(runs):
    run = runs("hash grid")
    packed, grid = pack(run), run.renderer.occupancy
    bits = np.unpackbits(part(packed, "occupied", np.uint8), bitorder="little")[: grid.occupied.numel()]
    assert np.array_equal(bits.reshape(grid.occupied.shape), grid.occupied.numpy())
    rows = part(packed, "centres", "<f4").reshape(-1, 4)
    count = len(run.diagram.centres)
    child, offsets = rows[:count, 3].copy().view("<i4"), part(packed, "diagrams", "<u4")
    points = torch.rand(50, 3) - 0.5
    tables = [
        torch.tensor(values.copy()) for values in (rows[:count, :3], offsets[: run.diagram.child_offsets.numel()])
    ]
    cells = locate_cell(points, tables[0], tables[1].int(), torch.tensor(child), depth=run.diagram.depth)
    assert torch.equal(cells, run.diagram.locate(points))
    places = np.array(packed.scene["cameras"])[:, [3, 7, 11]]
    apart = np.abs(places[:, None] - run.scene.train.cameras.origins.numpy()).max(-1)
    assert (apart.min(0) < 1e-5).all() and (apart.min(1) < 1e-5).all()  # a permutation


def test_a_page_is_one_file_that_loads_nothing(runs, tmp_path):
    run, path = runs("hash grid"), tmp_path / "deep" / "scene.html"
    packed, size = export_web(run, path)
    text = path.read_text()
    page = Page(text)
    assert size == path.stat().st_size and list(path.parent.iterdir()) == [path]
    assert zlib.decompress(b64decode(page.texts["data"])) == packed.data
    assert packed.summary == f"{run.diagram.num_cells} cells: networks of 0.02 MB, a table of 0.13 MB, 9 cameras"
    policy = next(attrs["content"] for _, attrs in page.tags if attrs.get("http-equiv") == "Content-Security-Policy")
    assert policy.startswith("default-src 'none'; script-src 'sha256-") and "unsafe" not in policy
    linked = [attrs[name] for _, attrs in page.tags for name in ("src", "href") if name in attrs]
    assert all(link.startswith("data:") for link in linked) and "https:" not in page.texts["script"]
    refuses("the file must end in .html", export_web, run, tmp_path / "scene.htm")


def test_a_hostile_name_is_text(runs):
    packed = pack(replace(runs("hash grid"), scene=replace(runs("hash grid").scene, name=HOSTILE)))
    own, usual = (Page(page_of(each, b"")) for each in (packed, pack(runs("hash grid"))))
    assert [tag for tag, _ in own.tags] == [tag for tag, _ in usual.tags]
    assert json.loads(own.texts["scene"])["name"] == HOSTILE and own.texts["title"] == HOSTILE
    assert own.texts["script"] == usual.texts["script"]
    assert HOSTILE not in packed.shader


def changed(run, field=None, sampler=None, scene=None):
    renderer = run.renderer
    if field is not None:
        grid = renderer.occupancy
        renderer = renderer_of({"field": field}, samples=8, occupancy=grid)
    if sampler is not None:
        renderer = renderer_of({"field": run.renderer.field}, samples=8)
        renderer.sampler = sampler
    return replace(run, renderer=renderer, scene=scene or run.scene)


def test_what_cannot_be_drawn_is_refused_in_a_line(runs, tmp_path):
    run, path = runs("hash grid"), tmp_path / "scene.html"
    centres = run.diagram.centres[:3]

    def refused(message, other):
        refuses(message, export_web, other, path, error=CannotDraw)
        assert not path.exists()

    def formula(positions, directions, ray_index):
        return torch.zeros_like(positions), torch.zeros_like(positions[:, 0])

    cones = renderer_of({"field": VoronoiRouter(MipNeRF(width=8, depth=2), centres)}, samples=8, cones=True)
    refused("its field takes cones", replace(run, renderer=cones))
    refused("no occupancy grid; train it with --occupancy", changed(run, sampler=Stratified(8)))
    refused("does not have one network per cell (the field is a function, not a VoronoiRouter)", changed(run, formula))
    wide = VoronoiRouter(NeRF(width=256, depth=8), centres)
    refused("numbers per sample, a page allows 2,000", changed(run, wide))

    class Odd(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(6, 4)

        def forward(self, positions, directions):
            raw = self.layer(torch.cat([positions, directions], -1))
            return raw[:, :3].sigmoid(), torch.erf(raw[:, 3])

    odd = VoronoiRouter(Odd(), centres, coords="first3", fuse=True)
    refused("its networks have a step function erf", changed(run, odd))
    endless = replace(run.scene, far=float("inf"))
    refused("a number that a page cannot use, inf", changed(run, scene=endless))


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e6])
def test_numbers_that_are_none_are_refused(runs, value):
    for name in ("features", "trunk.0.weight", "density.bias"):
        run = random_run("hash grid")
        with torch.no_grad():
            run.router.module.get_parameter(name).view(-1)[-1] = value
        refuses("not all finite numbers of at most 65,504", pack, run, error=CannotDraw)
    run = random_run("hash grid")
    run.diagram.centres[0, 0] = value
    if value != 1e6:
        refuses("its centres are not finite", pack, run, error=CannotDraw)


def test_sizes_are_bounded_before_memory_is_asked_for(runs, monkeypatch):
    monkeypatch.setattr(packing_file, "LARGEST", 2**16)
    monkeypatch.setattr(packing_file, "_half", None)
    refuses("its part table takes 0.1 MiB, of 0.0625 at most", pack, runs("hash grid"), error=CannotDraw)


def test_the_shader_is_that_of_the_field(runs):
    text = pack(runs("nerf")).shader
    assert "linear, 33 to 18, relu" in text and "const STRATA = 70u;" in text
    assert re.findall(r"octave < (\d+)u", text) == ["5", "4"]
    assert "struct Level" not in text and "struct Level" in pack(runs("hash grid")).shader


@pytest.mark.parametrize(("size", "factor"), [(0.1, 1.0), (0.6, None), (1.5, 2.0)])
def test_the_turntable_shows_all_of_an_object(size, factor):
    """If an object does not fit into the pictures, the focal lengths are reduced, by a factor of two at most."""
    cameras = orbit_cameras(5, radius=3.0, elevation=20.0, width=60, height=40, focal=70.0)
    points = (torch.rand(500, 3) - 0.5) * 2 * size
    wide = wide_enough(cameras, points)
    factors = cameras.intrinsics[:, :2] / wide.intrinsics[:, :2]
    assert (factors == (factor or factors[0, 0])).all() and torch.equal(
        wide.intrinsics[:, 2:], cameras.intrinsics[:, 2:]
    )
    if factor is None:
        seen = torch.stack([wide.project(points, index)[0] for index in range(5)])
        assert 1 < factors[0, 0] < 2
        assert seen.min() >= -1e-3 and seen[..., 0].max() <= 60.001 and seen[..., 1].max() <= 40.001
        assert min(seen.min(), 60 - seen[..., 0].max(), 40 - seen[..., 1].max()) < 0.01  # no wider than needed
