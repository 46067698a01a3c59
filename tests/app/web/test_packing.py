"""Tests of a page's packed data, without a browser."""

from __future__ import annotations

import json
import zlib
from base64 import b64decode
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from helpers import refuses, renderer_of
from random_runs import random_run

from voronerf import NeRF, VoronoiRouter
from voronerf.app.web import CannotDraw, export_web, pack, page_of
from voronerf.app.web import packing as packing_file
from voronerf.app.web.page import wide_enough
from voronerf.nerf import orbit_cameras
from voronerf.nerf.fields import MipNeRF

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


def test_all_training_cameras_are_in_a_page(runs):
    run = runs("hash grid")
    places = np.array(pack(run).scene["cameras"])[:, [3, 7, 11]]
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


def test_what_cannot_be_drawn_is_refused_in_a_line(runs, tmp_path):
    run, path = runs("hash grid"), tmp_path / "scene.html"
    centres, grid = run.diagram.centres[:3], run.renderer.occupancy

    def refused(message, field=run.renderer.field, **options):
        renderer = renderer_of({"field": field}, samples=8, **{"occupancy": grid, **options})
        refuses(message, export_web, replace(run, renderer=renderer), path, error=CannotDraw)
        assert not path.exists()

    def formula(positions, directions, ray_index):
        return torch.zeros_like(positions), torch.zeros_like(positions[:, 0])

    cones = VoronoiRouter(MipNeRF(width=8, depth=2), centres)
    refused("its field takes cones", cones, occupancy=None, cones=True)
    refused("no occupancy grid; train it with --occupancy", occupancy=None)
    refused("does not have one network per cell (the field is a function, not a VoronoiRouter)", formula)
    wide = VoronoiRouter(NeRF(width=256, depth=8), centres)
    refused("numbers per sample, a page allows 2,000", wide)

    class Odd(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(6, 4)

        def forward(self, positions, directions):
            raw = self.layer(torch.cat([positions, directions], -1))
            return raw[:, :3].sigmoid(), torch.erf(raw[:, 3])

    refused("its networks have a step function erf", VoronoiRouter(Odd(), centres, coords="first3", fuse=True))
    endless = replace(run, scene=replace(run.scene, far=float("inf")))
    refuses("a number that a page cannot use, inf", export_web, endless, path, error=CannotDraw)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e6])
def test_numbers_that_are_none_are_refused(value):
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


@pytest.mark.parametrize(("size", "factor"), [(0.1, 1.0), (0.6, None), (1.5, 2.0)])
def test_the_turntable_shows_all_of_an_object(size, factor):
    """If an object does not fit into the pictures, the focal lengths are reduced, by a factor of two at most."""
    cameras = orbit_cameras(5, radius=3.0, elevation=20.0, width=60, height=40, focal=70.0)
    points = (torch.rand(500, 3) - 0.5) * 2 * size
    wide = wide_enough(cameras, points)
    factors = cameras.intrinsics[:, :2] / wide.intrinsics[:, :2]
    assert (factors == (factor or factors[0, 0])).all()
    assert torch.equal(wide.intrinsics[:, 2:], cameras.intrinsics[:, 2:])
    if factor is None:
        seen = torch.stack([wide.project(points, index)[0] for index in range(5)])
        assert 1 < factors[0, 0] < 2
        assert seen.min() >= -1e-3 and seen[..., 0].max() <= 60.001 and seen[..., 1].max() <= 40.001
        assert min(seen.min(), 60 - seen[..., 0].max(), 40 - seen[..., 1].max()) < 0.01  # no wider than needed
