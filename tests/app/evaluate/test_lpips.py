"""Tests of LPIPS against a slow float64 version and the lpips package, and of the search for its weights."""

import importlib.machinery
import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import refuses
from pictures_by_formula import FIGURES, pictures_by_formula
from safetensors.torch import save_file

from voronerf.app.evaluate import lpips as module
from voronerf.app.evaluate.lpips import SHAPES, Lpips, LpipsError, find_lpips, read_weights

DATA = Path(os.environ.get("VORONERF_DATA", Path(__file__).parents[3].parent / "shared" / "data"))


@pytest.fixture(autouse=True)
def nothing_installed(monkeypatch):
    """Hides all LPIPS weights of the machine."""
    monkeypatch.delenv("VORONERF_LPIPS", raising=False)
    monkeypatch.delenv("VORONERF_DATA", raising=False)
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)


@pytest.fixture(scope="module")
def weights():
    generator = torch.Generator().manual_seed(1)
    drawn = {}
    for name, shape in SHAPES.items():
        values = torch.randn(shape, generator=generator)
        fan = math.prod(shape[1:]) if len(shape) > 1 else 10
        drawn[name] = values.abs() if name.startswith("lin") else values * (2 / fan) ** 0.5
    return drawn


def patches(x, size, stride, padding):
    """Returns the patches that a convolution reads from an image [c, h, w], as [rows, columns, c, size, size]."""
    x = np.pad(x, ((0, 0), (padding, padding), (padding, padding)))
    rows, columns = ((extent - size) // stride + 1 for extent in x.shape[1:])
    views = [
        [x[:, i : i + size, j : j + size] for j in range(0, columns * stride, stride)]
        for i in range(0, rows * stride, stride)
    ]
    return np.array(views)


def slow_lpips(image, truth, weights):
    """Computes LPIPS pixel by pixel, with equation 1 of the paper."""
    maps = [np.moveaxis(2 * p.astype(np.float64) - 1, -1, 0) for p in (image, truth)]
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    maps = [(p - shift[:, None, None]) / scale[:, None, None] for p in maps]
    total = 0.0
    for level, index in enumerate((0, 3, 6, 8, 10)):
        kernel, bias = (weights[f"features.{index}.{name}"].double().numpy() for name in ("weight", "bias"))
        size, stride, padding = {0: (11, 4, 2), 3: (5, 1, 2)}.get(index, (3, 1, 1))
        if index in (3, 6):
            maps = [np.moveaxis(patches(p, 3, 2, 0).max((3, 4)), -1, 0) for p in maps]
        maps = [
            np.maximum(np.einsum("rkcij,ocij->ork", patches(p, size, stride, padding), kernel) + bias[:, None, None], 0)
            for p in maps
        ]
        linear = weights[f"lin{level}.model.1.weight"].double().numpy().ravel()
        scores = []
        for y in range(maps[0].shape[1]):
            for x in range(maps[0].shape[2]):
                a, b = (p[:, y, x] / (math.sqrt(sum(v * v for v in p[:, y, x])) + 1e-10) for p in maps)
                scores.append(sum(w * (s - t) ** 2 for w, s, t in zip(linear, a, b)))
        total += sum(scores) / len(scores)
    return total


@pytest.mark.parametrize(("height", "width"), [(31, 31), (31, 52), (44, 35)])
def test_against_patches_and_sums(height, width, weights):
    image, truth = pictures_by_formula(height, width)
    score = Lpips(weights)(torch.from_numpy(image), torch.from_numpy(truth))
    assert float(score) == pytest.approx(slow_lpips(image, truth, weights), rel=1e-5)
    assert float(Lpips(weights)(torch.from_numpy(truth), torch.from_numpy(truth))) == 0


@pytest.mark.data
@pytest.mark.parametrize("figures", FIGURES, ids=lambda figures: f"{figures.height}x{figures.width}")
def test_against_the_lpips_package(figures):
    if not (DATA / "lpips").is_dir():
        pytest.skip(f"{DATA / 'lpips'} is not there; set VORONERF_DATA to a folder that holds lpips")
    lpips = find_lpips(DATA / "lpips")
    image, truth = (torch.from_numpy(p) for p in pictures_by_formula(figures.height, figures.width))
    assert float(lpips(image, truth)) == pytest.approx(figures.lpips, rel=2e-5)


def test_shapes_and_small_images(weights):
    score = Lpips(weights)
    rule = "same shape [h, w, 3], got [40, 40, 3] and [40, 41, 3]"
    refuses(rule, score, torch.zeros(40, 40, 3), torch.zeros(40, 41, 3))
    rule = "at least 31 x 31, AlexNet's smallest, got 30 x 40"
    refuses(rule, score, torch.zeros(30, 40, 3), torch.zeros(30, 40, 3))


def test_where_weights_are_looked_for(tmp_path, weights, monkeypatch):
    scenes = tmp_path / "scenes"
    (scenes / "lego").mkdir(parents=True)
    assert find_lpips(None, str(scenes / "lego")) is None
    (scenes / "lpips").mkdir()
    (scenes / "lpips" / "README").write_text("none yet")
    assert find_lpips(None, str(scenes / "lego")) is None
    save_file(weights, scenes / "lpips" / "lpips_alex.safetensors")
    assert find_lpips(None, str(scenes / "lego")) is not None
    (scenes / "lego" / "transforms.json").touch()
    assert find_lpips(None, str(scenes / "lego" / "transforms.json")) is not None
    assert find_lpips(None, "builtin") is None
    monkeypatch.setenv("VORONERF_DATA", str(scenes))
    assert find_lpips(None, "builtin") is not None
    assert find_lpips(Path("off"), "builtin") is None
    monkeypatch.setenv("VORONERF_LPIPS", "off")
    assert find_lpips(None, str(scenes / "lego")) is None
    monkeypatch.setenv("VORONERF_LPIPS", str(tmp_path / "gone"))
    absent = "there is no such file or folder, as set by"
    refuses(f"gone: {absent} VORONERF_LPIPS", find_lpips, None, error=LpipsError)
    refuses(f"away: {absent} --lpips", find_lpips, tmp_path / "away", error=LpipsError)
    file = scenes / "lpips" / "lpips_alex.safetensors"
    assert find_lpips(file) is not None
    monkeypatch.setenv("VORONERF_LPIPS", str(file))
    assert find_lpips(None, size=(16, 40)) is None
    rule = "--lpips must be off or come with larger images: images of 16 x 40"
    refuses(rule, find_lpips, file, size=(16, 40), error=LpipsError)


def test_the_installed_package(tmp_path, weights, monkeypatch):
    package, hub = tmp_path / "lpips", tmp_path / "hub"
    spec = importlib.machinery.ModuleSpec("lpips", None, is_package=True)
    spec.submodule_search_locations = [str(package)]
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: spec)
    monkeypatch.setattr(module.torch.hub, "get_dir", lambda: str(hub))
    (package / "weights" / "v0.1").mkdir(parents=True)
    (hub / "checkpoints").mkdir(parents=True)
    linear = {name: weights[name] for name in SHAPES if name.startswith("lin")}
    torch.save(linear, package / "weights" / "v0.1" / "alex.pth")
    assert find_lpips(None) is None
    rest = {name: weights[name] for name in SHAPES if name.startswith("features")}
    torch.save({**rest, "classifier.1.weight": torch.zeros(2)}, hub / "checkpoints" / "alexnet-owt-7be5be79.pth")
    lpips = find_lpips(None)
    assert all(torch.equal(lpips.weights[name], weights[name]) for name in SHAPES)


def test_names_of_the_whole_network_and_several_files(tmp_path, weights):
    slices = {0: 1, 3: 2, 6: 3, 8: 4, 10: 5}
    whole = {
        f"net.slice{slices[int(name.split('.')[1])]}.{name[9:]}" if name.startswith("features") else name: tensor
        for name, tensor in weights.items()
    }
    torch.save(whole, tmp_path / "lpips.pth")
    assert all(torch.equal(t, weights[n]) for n, t in read_weights([tmp_path / "lpips.pth"]).items())
    folder = tmp_path / "parts"
    folder.mkdir()
    torch.save({n: t for n, t in weights.items() if n.startswith("lin")}, folder / "alex.pth")
    save_file({n: t for n, t in weights.items() if n.startswith("features")}, folder / "alexnet.safetensors")
    torch.save({"lin0.model.1.weight": torch.ones(1, 64, 1, 1)}, folder / "vgg.pth")  # weights of another network
    lpips = find_lpips(folder)
    os.truncate(folder / "alexnet.safetensors", 0)  # reading a mapped page would end the process by SIGBUS
    assert all(torch.equal(lpips.weights[name], weights[name]) for name in SHAPES)
    assert lpips is not None and torch.equal(lpips.weights["lin0.model.1.weight"], weights["lin0.model.1.weight"])


def test_bad_files(tmp_path, weights):
    def error(name):
        with pytest.raises(LpipsError) as caught:
            find_lpips(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value) and "\n" not in str(caught.value)
        return str(caught.value)

    for name in ("cut.safetensors", "cut.pth"):
        (tmp_path / name).write_bytes(b"x" * 100)
        assert "not a readable file of weights" in error(name)
    torch.save(torch.zeros(3), tmp_path / "tensor.pth")
    assert "not a readable file of weights" in error("tensor.pth")
    partial = {name: tensor for name, tensor in weights.items() if name != "features.6.bias"}
    save_file(partial, tmp_path / "partial.safetensors")
    assert error("partial.safetensors").endswith("AlexNet: features.6.bias missing")
    save_file({"other": torch.zeros(1)}, tmp_path / "other.safetensors")
    assert error("other.safetensors").endswith("features.3.weight, features.6.weight and 12 more missing")
    save_file({**weights, "lin2.model.1.weight": torch.zeros(1, 3, 1, 1)}, tmp_path / "shape.safetensors")
    assert "lin2.model.1.weight must have shape [1, 384, 1, 1], got [1, 3, 1, 1]" in error("shape.safetensors")
    (tmp_path / "empty").mkdir()
    assert "holds no file of weights" in error("empty")
