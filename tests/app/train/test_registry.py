"""Tests of the field registry: registered modules are trained, split, resumed and scored by name."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
import torch.nn.functional as F
from helpers import on_any_number_of_threads, refuses, trained
from tiny_runs import steps_of
from torch import Tensor, nn

from voronerf import MLP, Layer
from voronerf.app import open_run
from voronerf.app.cli import main
from voronerf.app.scenes import Scene, builtin_scene
from voronerf.app.train import snapshot
from voronerf.app.train.build import build, count_parameters
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.defaults import resolve
from voronerf.nerf.fields import FIELDS, NeRF, register_field
from voronerf.router import CellProgram, layered_program


class Table(nn.Module):
    """A layer table of sine layers on the position, without a view direction."""

    def __init__(self, width: int = 12, omega: float = 3.0) -> None:
        super().__init__()
        self.omega = omega
        self.layers = MLP((Layer(("positions",), width, "sine"), Layer((0,), 4)), (1,))
        self.hidden, self.out = nn.Linear(3, width), nn.Linear(width, 4)

    def program(self) -> CellProgram:
        return layered_program(self.layers, [self.hidden, self.out], self.activate)

    def activate(self, raw: Tensor) -> tuple[Tensor, Tensor]:
        return torch.sigmoid(raw[:, :3]), F.softplus(raw[:, 3]) * self.omega


class OwnEncoding(NeRF):
    """A NeRF with a custom encoding, whose frequencies each cell learns."""

    def __init__(self, width: int = 8, depth: int = 1) -> None:
        super().__init__(width, depth, position_octaves=2, view_directions=False)
        self.frequencies = nn.Parameter(torch.ones(3))

    def forward(self, positions: Tensor, directions: Tensor | None = None, ray_index: Tensor | None = None) -> Any:
        return super().forward(torch.sin(positions * self.frequencies))


class Fourier(nn.Module):
    """Linear layers on fixed Fourier features, which all cells share."""

    router_options: ClassVar[dict[str, Any]] = {"fuse": True}

    def __init__(self, width: int = 8) -> None:
        super().__init__()
        self.register_buffer("waves", torch.linspace(-4, 4, 18).reshape(3, 6))
        self.hidden, self.out = nn.Linear(6, width), nn.Linear(width, 4)

    def forward(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        raw = self.out(F.relu(self.hidden(torch.sin(positions @ self.waves))))
        return torch.sigmoid(raw[:, :3]), F.softplus(raw[:, 3])


class Foreign(nn.Module):
    """A plain module of positions and directions with its own learning rate and option."""

    def __init__(self, hidden: int, growth: float = 1.0, kind: str = "relu") -> None:
        super().__init__()
        self.kind, self.growth = kind, growth
        self.trunk = nn.Sequential(nn.Linear(6, hidden), nn.ReLU() if kind == "relu" else nn.Tanh())
        self.head = nn.Linear(hidden, 4)

    @staticmethod
    def learning_rate(hidden: int, **_: object) -> float:
        return 0.08 / hidden

    def forward(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        raw = self.head(self.trunk(torch.cat([positions, directions], -1)))
        return torch.sigmoid(raw[:, :3]), F.softplus(raw[:, 3:]) * self.growth


class Balls(nn.Module):
    """A module that takes Gaussians as inputs."""

    inputs = "gaussians"
    router_options: ClassVar[dict[str, Any]] = {"fuse": True}

    def __init__(self, width: int = 8) -> None:
        super().__init__()
        self.layer = nn.Linear(6, 4)

    def forward(self, positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        raw = self.layer(positions)
        return torch.sigmoid(raw[:, :3]), F.softplus(raw[:, 3])


KINDS: dict[str, tuple[type[nn.Module], dict[str, Any]]] = {
    "table": (Table, {"field_options": ("omega=5.0",)}),
    "own-encoding": (OwnEncoding, {}),
    "fourier": (Fourier, {}),
    "foreign": (Foreign, {"field_options": ("hidden=8", "kind=tanh")}),
    "balls": (Balls, {}),
}


@pytest.fixture(autouse=True)
def table() -> Iterator[None]:
    """Registers the fields of this file, and restores the registry afterwards."""
    before = dict(FIELDS)
    for name, (kind, _) in KINDS.items():
        register_field(name)(kind)
    yield
    FIELDS.clear()
    FIELDS.update(before)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return builtin_scene(16, train_views=8, test_views=2)


def small(out: Path, **settings: Any) -> TrainConfig:
    kept: dict[str, Any] = {"occupancy": False, "evaluations": 1}
    return TrainConfig(out=out, steps=20, cells=(3,), split_at=(0.5,), rays=64, samples=(8,), **{**kept, **settings})


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize("name", KINDS)
def test_every_kind_of_field_is_trained_split_resumed_and_scored(tmp_path: Path, scene: Scene, name: str) -> None:
    config = small(tmp_path / "whole", field=name, **KINDS[name][1])
    summary = trained(config, scene)
    resolved = resolve(config, scene)
    assert summary["cells"] == 3 and summary["parameters"] == count_parameters(resolved)

    part = replace(config, out=tmp_path / "part")
    trained(part, scene, stop_at=14)
    trained(part, scene, resume=True)
    whole, resumed = (load_checkpoint(checkpoint_path(tmp_path / run)).tensors for run in ("whole", "part"))
    assert whole.keys() == resumed.keys() and all(torch.equal(whole[key], resumed[key]) for key in whole)
    changed = [key for key in whole if key.startswith("router.module.") and not torch.equal(*whole[key][:2])]
    assert changed  # the cells have changed since the split

    run = open_run(tmp_path / "whole", scene=scene)
    assert isinstance(run.router.module, KINDS[name][0])
    assert run.evaluate()["psnr"] == summary["psnr"]
    assert run.render(1).colour.shape == (16, 16, 3)
    if name in ("table", "fourier", "balls"):  # a layer table, or fuse=True
        assert "fused" in run.router.explain()
    del FIELDS[name]
    with pytest.raises(ConfigError, match=f"register_field adds others, got '{name}'"):
        open_run(tmp_path / "whole", scene=scene)


def test_steps_of_what_is_one_program_do_not_depend_on_threads(scene: Scene) -> None:
    states = {name: build(small(Path("run"), field=name, **KINDS[name][1]), scene) for name in KINDS}
    alone = {name for name, state in states.items() if state.thread_deterministic}
    assert alone == {"table", "fourier", "balls"}, "given, or traced for the question"

    def four_steps() -> list[Tensor]:
        # PyTorch splits tensors of 32,768 or more elements among threads; 521 x 67 elements give uneven parts.
        config = replace(small(Path("run"), field="fourier"), steps=4, rays=521, samples=(67,), split_at=(0.5,))
        state = steps_of(build(config, scene), 4)
        return [tensor for _, tensor in sorted(snapshot(state).tensors.items())]

    on_any_number_of_threads(four_steps, (1, 2, 8))


def test_options_reach_the_field(scene: Scene) -> None:
    config = resolve(TrainConfig(field="foreign", field_options=("hidden=16", "growth=2.5", "kind=tanh")), scene)
    assert config.lr == 0.08 / 16 and (config.width, config.depth) == (None, None)
    field = config.field_type.build(config.network_options)
    assert isinstance(field, Foreign) and (field.growth, field.kind, field.head.in_features) == (2.5, "tanh", 16)
    nerf = TrainConfig(field="nerf", field_options=("density_scale=20",), depth=2)
    built = nerf.field_type.build({**nerf.network_options, "position_octaves": 3})
    assert isinstance(built, NeRF) and built.density_scale == 20 and len(built.trunk) == 2
    assert TrainConfig.from_values(nerf.to_values()) == nerf
    solved = build(TrainConfig(field="table", parameters=400, cells=()), scene).config
    assert solved.width == 49 and count_parameters(solved) == 8 * 49 + 4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"field": "siren"}, "--field must be nerf, mipnerf, kilonerf, hashgrid, table, own-encoding, fourier, fo"),
        ({"field": "table", "depth": 3}, "--depth must not come with --field table, got 3"),
        ({"field_options": ("gain",)}, "--field-options must be NAME=VALUE, got 'gain'"),
        *(
            (
                {"field": "nerf", "field_options": (f"density_scale={value}",)},
                f"--field-options must give density_scale a finite number, got 'density_scale={value}'",
            )
            for value in ("nan", "1e999", "x")
        ),
        (
            {"field": "nerf", "field_options": ("gain=2",)},
            "--field-options of nerf are skips, .*, density_scale, .*; got 'gain=2'",
        ),
        ({"field_options": ("width=2",)}, "--field-options must not hold width, use --width; got 'width=2'"),
        ({"field": "balls", "field_options": ("gain=2",)}, "--field-options of balls are none; got 'gain=2'"),
    ],
)
def test_settings_that_a_field_has_no_option_for(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TrainConfig(**settings)


def test_what_cannot_be_built(scene: Scene) -> None:
    refuses("field foreign: hidden must be given", FIELDS["foreign"].build, {})
    with pytest.raises(ValueError, match=r"field table: .*unexpected keyword argument 'depth'"):
        FIELDS["table"].build({"depth": 2})
    refuses("NeRF: width must be at least 2, got 1", FIELDS["nerf"].build, {"width": 1})
    with pytest.raises(ConfigError, match="--parameters needs a field with an option width, foreign has none"):
        build(TrainConfig(field="foreign", field_options=("hidden=8",), parameters=100), scene)


def test_what_cannot_be_registered() -> None:
    refuses("name must be a word, got 'my field'", register_field, "my field")
    with pytest.raises(ValueError, match="inputs of rays must be 'points' or 'gaussians', got 'rays'"):
        register_field("rays")(type("Rays", (nn.Module,), {"inputs": "rays"}))


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (lambda x: x, r"forward must return \(colour, density\), got Tensor"),
        (lambda x: (x, x), r"a colour \[\d+, 3\] and a density \[\d+\], got \[\d+, 3\] and \[\d+, 3\]"),
    ],
)
def test_a_field_that_returns_something_else(tmp_path: Path, scene: Scene, answer: Any, message: str) -> None:
    class Odd(nn.Linear):
        def __init__(self) -> None:
            super().__init__(3, 3)

        def forward(self, positions: Tensor, directions: Tensor) -> Any:
            return answer(super().forward(positions))

    register_field("odd")(Odd)
    with pytest.raises(ValueError, match=message):
        trained(small(tmp_path, field="odd", lr=0.01), scene)


def test_the_command_line_takes_registered_fields(tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    tiny = ["--downscale", "12", "--steps", "4", "--cells", "--rays", "32", "--samples", "8", "--eval-views", "1"]
    plain = ["--panels", "0", "--lpips", "off"]
    assert main(["train", "--out", run, "--field", "foreign", "--field-options", "hidden=8", *tiny, *plain]) == 0
    assert main(["eval", run, "--views", "1", *plain]) == 0
