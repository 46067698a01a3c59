"""Tests without a browser that a page's shaders draw the picture that `Run.render` renders."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from random_runs import KINDS, random_run
from wgsl import compiled

from voronerf.app import web
from voronerf.app.web import pack

#: The image size in pixels, and two strips of rows that are drawn one after the other.
WIDTH, HEIGHT, STRIPS = 12, 9, ((0, 5), (5, 9))
LENS = torch.tensor([[13.0, 14.0, 5.0, 5.5]])
#: C++ code that draws pixel (x, y).
DRAW = "draw(vec3u(x, y, 0));"
SHOW = "static_cast<vec4f*>(bound[4])[y * width + x] = show(vec4f(x + 0.5f, y + 0.5f, 0, 1));"
CONTRACTED = ("ahead", "a sphere")
CONTRACT = "vec4f& place = static_cast<vec4f*>(bound[7])[x]; place = vec4f(contracted(place.lanes<0, 1, 2>()), 0);"


@pytest.fixture(scope="module")
def shaders(runs, tmp_path_factory):
    """A function that runs a shader by its name: KIND, "contract KIND" or "screen", where KIND is a kind of run."""
    texts = {kind: pack(runs(kind)).shader for kind in KINDS}
    parts = {kind: (text, DRAW) for kind, text in texts.items()}
    parts |= {f"contract {kind}": (texts[kind], CONTRACT) for kind in CONTRACTED}
    parts["screen"] = Path(web.__file__).with_name("screen.wgsl").read_text(), SHOW
    return compiled(tmp_path_factory.mktemp("shaders"), parts)


def camera(run):
    return replace(run.scene.test.cameras[3:4], intrinsics=LENS, width=WIDTH, height=HEIGHT)


def drawn(shaders, run, kind, *, cut=(3.0, 0.0), hidden=()):
    """Draws a picture as renderer.js does; returns (screen colours [h, w, 3], pixels as uint32 [h, w, 4])."""
    packed, cameras = pack(run), camera(run)
    parts = {
        key: np.frombuffer(packed.data, np.uint8)[at : at + size] for key, (at, size) in packed.scene["parts"].items()
    }
    colours, bits = parts.pop("colours"), np.zeros(-(-run.diagram.num_cells // 32), np.uint32)
    for cell in hidden:
        bits[cell // 32] |= np.uint32(1 << cell % 32)
    pixels, seen = np.zeros((HEIGHT, WIDTH, 4), np.uint32), np.zeros((HEIGHT, WIDTH, 4), np.float32)
    view = np.zeros(28, np.float32)
    view[:16].reshape(4, 4)[:, :3] = cameras.poses[0, :3].T
    view[16:20], view[24:26] = LENS[0], cut
    for strip in STRIPS:
        view.view(np.uint32)[20:24] = WIDTH, HEIGHT, *strip
        shaders(kind, 16, 8, view, *parts.values(), bits, pixels)
    screen = np.zeros(12, np.float32)
    screen[:2], screen[8:] = (WIDTH, HEIGHT), (1, 1, 1, 1) if packed.scene["background"] else 0
    screen.view(np.uint32)[2:8] = WIDTH, HEIGHT, WIDTH, HEIGHT, HEIGHT, 0
    shaders("screen", WIDTH, HEIGHT, screen, pixels, pixels, colours, seen)
    return seen[..., :3], pixels


def test_every_kind_of_field_and_space_is_drawn(shaders, runs):
    for kind in KINDS:
        run = runs(kind)
        seen, pixels = drawn(shaders, run, kind)
        rendered = run.render(camera(run))
        colour, hit = rendered.colour.clamp(0, 1).numpy(), rendered.opacity.numpy() > 0.01
        assert colour.std() > 0.05 and hit.sum() > 30, kind
        assert np.sqrt(np.square(seen - colour).mean()) < 5e-4, kind
        assert np.abs(pixels.view(np.float32)[hit, 3] - rendered.depth.numpy()[hit]).max() < 0.01, kind
        cells = run.diagram.locate(rendered.heaviest).numpy()
        assert (pixels[hit, 2] == cells[hit] + 1).mean() > 0.95, kind


@pytest.mark.parametrize("kind", CONTRACTED)
def test_places_anywhere_are_contracted(shaders, runs, kind):
    contraction = runs(kind).scene.contraction
    points = contraction.centre + torch.randn(200, 3) * torch.logspace(-3, 3, 200)[:, None]
    places, unread = np.zeros((200, 4), np.float32), np.zeros(28, np.float32)
    places[:, :3] = points
    shaders(f"contract {kind}", 200, 1, *[unread] * 7, places)
    np.testing.assert_allclose(places[:, :3], contraction.points(points), rtol=1e-4, atol=1e-5)


def test_what_is_cut_away_or_hidden_is_not_seen(shaders, runs):
    run, rest, axis, first = runs("traced"), random_run("traced"), 0, 5
    rest.renderer.occupancy.occupied[first:] = False
    low, high = run.scene.box[:, axis].tolist()
    cut = axis, low + (high - low) * first / 9  # all rays approach the plane
    seen, _ = drawn(shaders, run, "traced", cut=cut)
    whole, pixels = drawn(shaders, run, "traced")
    assert np.abs(seen - whole).max() > 0.1
    assert np.abs(seen - rest.render(camera(run)).colour.clamp(0, 1).numpy()).max() < 0.01
    cells, cell = set(range(run.diagram.num_cells)), int(np.bincount(pixels[..., 2].flat)[1:].argmax())
    for hidden, shown in (({cell}, cells - {cell}), (cells - {cell}, {cell})):
        _, pixels = drawn(shaders, run, "traced", hidden=hidden)
        assert pixels[..., 2].any() and set(pixels[..., 2].flat) <= {0, *(each + 1 for each in shown)}
