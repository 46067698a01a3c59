"""Tests of scene.json in a run's folder, which lets the run render without the scene's images."""

from __future__ import annotations

import json
from dataclasses import fields, replace

import pytest
import torch
from helpers import refuses

from voronerf.app.scenes import SceneError, builtin_scene
from voronerf.app.scenes.record import read_scene, write_scene
from voronerf.nerf import Contraction
from voronerf.nerf.contraction import Perspective


@pytest.fixture(scope="module")
def scene():
    return builtin_scene(12, train_views=4, test_views=2)


def assert_same(one, other):
    for field in fields(one):
        a, b = getattr(one, field.name), getattr(other, field.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, field.name


SPACES = Contraction(torch.tensor([0.1, 0.2, 0.3]), 1.5), Perspective(torch.zeros(3), torch.eye(3), 0.7, (0.5, 0.4))


@pytest.mark.parametrize("contraction", [None, *SPACES])
def test_what_is_written_is_read(tmp_path, scene, contraction) -> None:
    lenses = {"distortion": torch.rand(4, 8), "models": torch.tensor([0, 2, 1, 0], dtype=torch.int32)}
    cameras = replace(scene.train.cameras, sizes=torch.tensor([[12, 12], [12, 10], [8, 12], [12, 12]]), **lenses)
    whole = replace(scene, contraction=contraction, box=None, train=replace(scene.train, cameras=cameras))
    for written in (scene, whole):
        write_scene(tmp_path / "scene.json", written)
        read = read_scene(tmp_path / "scene.json")
        for part in ("train", "test"):
            assert_same(getattr(written, part).cameras, getattr(read, part).cameras)
            assert getattr(written, part).names == getattr(read, part).names and len(getattr(read, part).images) == 0
        for name in ("name", "near", "far", "spacing", "background", "kind"):
            assert getattr(written, name) == getattr(read, name)
        assert type(read.contraction) is type(written.contraction)
        if read.contraction is not None:
            assert_same(written.contraction, read.contraction)
        assert (read.box is None) == (written.box is None) and (read.box is None or torch.equal(read.box, written.box))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda values: values.pop("near"), "near"),
        (lambda values: values.update(near=3.0, far=2.0), "near and far must satisfy 0 <= near < far, got 3.0 and 2.0"),
        (lambda values: values.update(kind="odd"), "kind must be one of"),
        (lambda values: values.update(box=[[0, 0, 0], [1, -1, 1]]), "box must be its lowest and highest corner"),
        (lambda values: values["train"].update(poses=[[1.0]]), "poses must have shape [c, 4, 4], got [1, 1]"),
        (lambda values: values["train"].update(poses=[float("nan")]), "poses must be finite"),
        (lambda values: values["train"].update(poses="all"), "record of a scene"),
        (lambda values: values["train"].update(width=1e9), "width and height must be integers, got 1000000000.0"),
        (lambda values: values["test"].update(names=[]), "must be as many as poses and at least one, got 0 and 2"),
        (lambda values: values.update(contraction={"kind": "odd"}), "record of a scene"),
        (lambda values: values.update(train=[]), "record of a scene"),
    ],
)
def test_bad_records_are_one_line(tmp_path, scene, change, message) -> None:
    path = tmp_path / "scene.json"
    write_scene(path, scene)
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    refuses(message, read_scene, path, error=SceneError)
