"""Tests of routers under another default device or default dtype of torch."""

import re
from pathlib import Path

import pytest
import torch
from helpers import all_pairs, python, same, seeded
from router_loop import tensors
from torch import nn

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter

FOLDER = Path(__file__).resolve().parent
# Long tests of the same code in threads, modes of torch and conventions of axes.
LONG = ("test_conventions.py", "test_router_inference.py", "test_router_threads.py")
# Tests of torch.compile, which cannot trace the mode of --device-in-package.
LEFT_OUT = (
    "test_call_cache.py::test_known_calls_are_part_of_a_graph",
    "test_call_cache.py::test_one_graph_for_any_number_of_samples",
    "test_call_cache.py::test_other_calls_break_a_graph_as_before",
    "test_labels.py::test_graphs_of_the_compiler",
    "test_missing_gradients.py::test_a_compiled_call",
    "test_program_arguments.py::test_is_part_of_a_graph_before_any_call_and_with_directions_of_rays",
)


class Scaled(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 4))

    def forward(self, x):
        return self.layers(x) * torch.arange(1.0, 5.0, dtype=x.dtype, device=x.device)


def made(kind, way):
    torch.manual_seed(0)
    module = NeRF(width=16, depth=2) if kind == "nerf" else Scaled()
    centres = torch.rand(6, 3, generator=seeded())
    return VoronoiRouter(module, centres, coords="first3", **({"fuse": True} if way == "fuse" else {"way": way}))


@pytest.fixture
def meta():
    """Returns a function that makes the default device meta, until the test ends."""
    yield lambda: torch.set_default_device("meta")
    torch.set_default_device(None)


@pytest.mark.parametrize(
    *all_pairs({"way": ["fused", "fuse", "grouped", "loop"], "kind": ["nerf", "scaled"], "n": [40, 3000]})
)
def test_calls_with_another_default_device(meta, kind, way, n):
    positions, results = torch.rand(n, 3, generator=seeded(1)), []
    arguments = (torch.nn.functional.normalize(positions, dim=-1),) if kind == "nerf" else ()
    for router in [made(kind, way) for _ in range(2)]:
        for _ in range(3):
            x = positions.clone().requires_grad_()
            router.zero_grad()
            outputs = tensors(router(x, *arguments))
            sum(output.square().sum() for output in outputs).backward()
        with torch.no_grad():
            silent = tensors(router(positions, *arguments))
        results.append([*outputs, x.grad, *silent, *(parameter.grad for parameter in router.parameters())])
        meta()
    assert same(*results)


def test_changes_of_cells_with_another_default_device(meta):
    points, results = torch.rand(600, 3, generator=seeded(1)), []
    routers = [made("scaled", "fused"), made("scaled", "fused"), VoronoiRouter(nn.Linear(3, 2), 4)]
    labels, weights = torch.arange(600) % 4, torch.ones(600)
    for router in routers[:2]:
        optimizer = torch.optim.Adagrad(router.parameters())
        router.freeze([1], optimizer=optimizer)
        router.unfreeze([])
        router.subdivide(2, optimizer=optimizer, points=points, weights=weights, generator=seeded())
        state = router.state_dict()
        results.append([*state.values(), router(points), router.part([0, 3])(points)])
        router.load_state_dict(state)
        meta()
    assert same(*results)
    assert routers[2](points, cells=labels).shape == (600, 2)
    assert VoronoiRouter(nn.Linear(3, 2, device="cpu"), 4)(points, cells=labels).shape == (600, 2)
    assert VoronoiDiagram.from_points(points, 4).centres.device.type == "cpu"


@pytest.mark.slow
def test_all_tests_with_another_default_device_in_the_package():
    """Runs the other quick tests; functions of the package see the default device meta, and the tests the CPU."""
    options = ("-q", "-m", "not slow", "-p", "no:cacheprovider", "--device-in-package", "meta")
    left_out = [f"--ignore={FOLDER / name}" for name in LONG]
    left_out += [option for name in LEFT_OUT for option in ("--deselect", f"tests/router/{name}")]
    said = python("-m", "pytest", *options, *left_out, FOLDER, cwd=FOLDER.parents[1], timeout=3600)
    assert re.search(r"[1-9]\d{2,} passed", said), said
