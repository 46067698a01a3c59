"""Tests of the hash grid field, alone and in a router, and of its settings, which depend on the scene."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import refuses

from voronerf import HashGridField, VoronoiRouter
from voronerf.app.scenes import SceneError, builtin_scene
from voronerf.app.train.build import check_memory, make_routers
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.defaults import resolve
from voronerf.nerf.fields.hashgrid import BOX_DENSITY, BOX_INITIAL


def rays(n):
    return torch.rand(n, 3), torch.nn.functional.normalize(torch.randn(n, 3), dim=-1)


def test_cells_share_the_grid_and_inherit_their_networks():
    field = HashGridField(width=16, log2_entries=10, levels=4)
    router = VoronoiRouter(field, torch.zeros(1, 3), share=["features"])
    x, d = rays(200)
    expected = field(x, d)
    router.subdivide(7, points=x, weights=torch.ones(200))
    assert router.module.features.shape == field.features.shape and router.module.colour.weight.shape == (7, 3, 16)
    for a, b in zip(router(x, d), expected, strict=True):
        torch.testing.assert_close(a, b)
    router(x, d)[1].sum().backward()
    assert router.module.features.grad is not None and router.module.features.grad.abs().sum() > 0


def test_every_unit_that_reads_the_grid_learns_from_the_first_sample():
    torch.manual_seed(0)
    field = HashGridField(width=16, log2_entries=10, levels=4)
    colour, density = field(*rays(1))
    (colour.sum() + density.sum()).backward()
    assert (field.trunk[0].bias.grad != 0).all()


def test_cells_with_tables_of_their_own():
    router = VoronoiRouter(HashGridField(width=16, log2_entries=10, levels=4), torch.rand(3, 3))
    x, d = rays(50)
    with torch.no_grad():
        router.module.features.normal_()
    actual, cells = router(x, d), router.diagram.locate(x)
    for cell in range(3):
        expected = router.cell(cell)(x[cells == cell], d[cells == cell])
        for a, b in zip(actual, expected, strict=True):
            torch.testing.assert_close(a[cells == cell], b)


def test_shared_layers_of_a_table():
    router = VoronoiRouter(HashGridField(width=16, levels=4), torch.rand(3, 3), share=["features", "trunk.*"])
    assert router.module.trunk[0].weight.shape == (16, 8) and router.module.view.weight.dim() == 3
    x, d = rays(50)
    expected = router.cell(0)(x, d)
    for a, b in zip(router(x, d), expected, strict=True):
        torch.testing.assert_close(a, b)


def test_settings_come_from_the_scene():
    scene, larger = (builtin_scene(side, train_views=2, test_views=1) for side in (20, 50))
    config = resolve(TrainConfig(field="hashgrid", field_options=("log2_entries=11", "levels=6")), scene)
    field = make_routers(config)["field"].module
    assert field.layers.grid.log2_entries == 11 and field.features.dim() == 2
    low, high = torch.tensor(field.layers.grid.box)
    torch.testing.assert_close((low + high) / 2, scene.box.mean(0))
    torch.testing.assert_close(high - low, (scene.box[1] - scene.box[0]).amax().expand(3))
    fine = make_routers(resolve(TrainConfig(field="hashgrid"), larger))["field"].module.layers.grid.finest
    assert 2.4 < fine / field.layers.grid.finest < 2.6
    assert resolve(config, scene) == config
    kept = resolve(TrainConfig(field="hashgrid", field_options=("finest=99",)), scene)
    assert make_routers(kept)["field"].module.layers.grid.finest == 99


def test_the_grid_grows_with_the_images():
    box = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    result = [HashGridField.scene_options(1 / pixels, box, False, 480) for pixels in (10, 40, 80, 100, 353)]
    assert [own["finest"] for own in result] == [32, 80, 160, 200, 706]
    assert [own["log2_entries"] for own in result] == [14, 14, 15, 15, 18]
    for seconds, entries in ((15, 17), (60, 19)):
        contracted = HashGridField.scene_options(1 / 353, box, True, seconds)
        assert contracted == {"box": box, "finest": 353, "log2_entries": entries, "density_scale": 40.0}


@pytest.mark.parametrize("side", [0.1, 2.5, 100.0])
def test_a_field_begins_alike_in_a_box_of_any_size(side):
    low, high = (0.0, 0.0, 0.0), (side, side / 2, side / 3)
    torch.manual_seed(0)
    field = HashGridField(**HashGridField.scene_options(side / 100, (low, high), False, 60))
    directions = torch.nn.functional.normalize(torch.randn(500, 3), dim=-1)
    _, density = field(torch.rand(500, 3) * torch.tensor(high), directions)
    assert 0.5 < float(density.mean()) * side / BOX_INITIAL < 2
    assert field.density_scale * side == pytest.approx(BOX_DENSITY)


def test_bad_settings():
    refuses("HashGridField: initial_density must be positive, got 0", HashGridField, initial_density=0)
    refuses("HashGridField: width must be at least 2 and depth 1, got 1 and 1", HashGridField, width=1)
    refuses("HashGrid: log2_entries must be an integer from 10 to 24, got 30", HashGridField, log2_entries=30)
    with pytest.raises(ConfigError, match=r"--field nerf of --width 4096 with 10000 cells needs .* GiB of"):
        check_memory(TrainConfig(field="nerf", cells=(10_000,), width=4096, depth=9))
    refuses("HashGridField: directions must be given", HashGridField(log2_entries=10), torch.rand(2, 3))
    capture = replace(builtin_scene(10, train_views=2, test_views=1), box=None)
    with pytest.raises(SceneError, match="builtin: has no box, a field that covers space needs contraction sphere or"):
        resolve(TrainConfig(contraction="none"), capture)


def test_a_table_that_does_not_fit_into_memory(monkeypatch):
    monkeypatch.setattr("voronerf.nerf.fields.hashgrid.physical_memory", lambda: 2**20)
    with pytest.raises(
        ValueError, match=r"log2_entries must be smaller: 8 levels .* take 1.6 MiB, the machine has 1.0"
    ):
        HashGridField()


@pytest.mark.parametrize(
    ("side", "contraction", "budget", "samples", "entries"),
    [
        *((100, "none", 37, 64, 15), (100, "none", 38, 128, 15), (20, "none", 480, 96, 14)),
        *((20, "sphere", 24, 128, 17), (20, "sphere", 25, 256, 19), (20, "sphere", 90, 384, 19)),
    ],
)
def test_large_images_and_long_trainings_get_more_of_both(side, contraction, budget, samples, entries):
    scene = builtin_scene(side, train_views=2, test_views=1)
    config = resolve(TrainConfig(contraction=contraction, budget=budget), scene)
    arguments = dict(text.split("=", 1) for text in config.field_options)
    assert config.samples == (samples,) and arguments.get("log2_entries") == (entries and str(entries))
    assert resolve(TrainConfig(samples=(7,), contraction=contraction), scene).samples == (7,)
    # The result is the same on a machine four times as fast, and for a budget in steps at any speed.
    arguments = [(TrainConfig(contraction=contraction, budget=budget / 4), 4.0)]
    arguments += [(TrainConfig(contraction=contraction, steps=100 * budget), speed) for speed in (0.01, 1.0, 64.0)]
    for settings, speed in arguments:
        result = resolve(settings, scene, speed)
        assert (result.samples, result.field_options) == (config.samples, config.field_options)
