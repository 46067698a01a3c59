"""What holds for every op: it compiles whole for any size, takes any strides, and its custom ops are registered well.

A new op is a line of `CASES`. What is particular to it, such as its formula, is in its own file.
"""

from __future__ import annotations

import pytest
import torch
from op_cases import need, offsets_of, strided
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map_only

from voronerf import HashGrid, backends, ops
from voronerf.layers import DIRECTIONS, MLP, POSITIONS, Layer

NETWORK = MLP((Layer((POSITIONS,), 6, "sine"), Layer((0, DIRECTIONS), 4, "sigmoid")), (1, 0), 2, 1)
GAUSSIANS = MLP(NETWORK.layers, NETWORK.outputs, 2, 1, "integrated")
HASHED = HashGrid(levels=3, features=2, log2_entries=10, base=3, finest=40, interpolation="smoothstep")
# The 16 features of whole vectors: what a forward pass keeps has no padding, which is never written.
EIGHT = HashGrid(levels=8, features=2, log2_entries=10, base=3, finest=40)
GRIDDED = MLP(NETWORK.layers, NETWORK.outputs, None, 1, "hash", EIGHT)
# Diagram 0 has three centres, the second and third refined by diagrams 1 and 2, and that again by diagram 3.
TREE = {
    "centres": torch.rand(10, 3, generator=torch.Generator().manual_seed(1)),
    "child_offsets": torch.tensor([0, 3, 5, 7, 10], dtype=torch.int32),
    "child": torch.tensor([-1, 1, 2, -2, -3, -4, 3, -5, -6, -7], dtype=torch.int32),
}


def index(n, below):
    return torch.randint(below, (n,), dtype=torch.int32)


def network(n, layers=NETWORK, k=2):
    """Samples, weights and biases of k cells."""
    p = 6 if layers.integrated else 3
    weights = [torch.randn(k, o, i) / i**0.5 for o, i in layers.weight_shapes(p, 3)]
    rays = {"directions": torch.randn(4, 3), "direction_index": index(n, 4)}
    return {"positions": torch.rand(n, p), "weights": weights, "biases": [torch.randn(k, 6), None], **rays}


def rays(n, s=5):
    """Densities and so on of n rays of s samples."""
    values = {"sigma": torch.rand(n, s), "rgb": torch.rand(n, s, 3), "depths": torch.rand(n, s)}
    return {**values, "deltas": torch.rand(n, s) / 2, "background": torch.rand(3)}


def packed(n):
    flat = {name: value.flatten(0, 1) if value.dim() > 1 else value for name, value in rays(n).items()}
    return {**flat, "ray_offsets": offsets_of([2, 0, 5 * n - 2])}


def march(n):
    start = {"uniforms": torch.rand(n, 7), "start": index(n, 3)}
    towards = torch.nn.functional.normalize(torch.randn(n, 3), dim=1)
    ends = {"near": torch.rand(n), "far": 3 + torch.rand(n), "box": torch.tensor([[-1.0] * 3, [1.0] * 3])}
    return {"origins": -towards, "directions": towards, "occupied": torch.rand(5, 4, 6) < 0.4, **ends, **start}


def cameras(n):
    some = {"poses": torch.eye(4).repeat(3, 1, 1), "intrinsics": 30 + torch.rand(3, 4), "camera": index(n, 3)}
    some["models"] = torch.arange(3, dtype=torch.int32)
    return {**some, "x": 64 * torch.rand(n), "y": 48 * torch.rand(n), "distortion": 0.01 * torch.randn(3, 8)}


def pixels(n):
    """n pixels of three images."""
    some = cameras(n)
    given = {name: some[name] for name in ("poses", "intrinsics", "distortion", "models")}
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    images = torch.randint(256, (3, 5, 7, 4), dtype=torch.uint8)
    return {**given, "images": images, "index": torch.randint(105, (n,)), "background": torch.rand(n, 3), "box": box}


def solids(n):
    frames = torch.cat([torch.eye(3).expand(4, 3, 3), torch.randn(4, 1, 3) / 2], dim=1)
    tables = {"kinds": torch.arange(4, dtype=torch.int32), "frames": frames, "sizes": 0.2 + 0.2 * torch.rand(4, 3)}
    origins = 4 * torch.nn.functional.normalize(torch.randn(n, 3), dim=1)
    return {**tables, "origins": origins, "directions": -origins / 4}


# For each: the tensors of n samples, and the other arguments.
CASES = {
    "nearest_centre": (
        lambda n: {"points": torch.rand(n, 3), "centres": torch.rand(7, 3), "weights": torch.rand(7)},
        {},
    ),
    "locate_cell": (lambda n: {"points": torch.rand(n, 3), **TREE, "weights": torch.rand(10)}, {"depth": 3}),
    "draw_cell": (
        lambda n: {"points": torch.rand(n, 3), **TREE, "uniforms": torch.rand(n, 3), "weights": torch.rand(10)},
        {"depth": 3, "temperature": 0.3},
    ),
    "cell_sort": (lambda n: {"cells": index(n, 6)}, {"k": 6}),
    "select_heaviest": (lambda n: {"points": torch.rand(n, 3), "importance": torch.rand(n)}, {"count": 4}),
    "balance_centres": (
        lambda n: {"samples": torch.rand(n, 3), "masses": torch.rand(n).double(), "centres": torch.rand(3, 3)},
        {"steps": 2},
    ),
    "camera_rays": (cameras, {}),
    "pixel_rays": (pixels, {"near": 0.2, "far": 3.0}),
    "cast_solids": (solids, {}),
    "march_rays": (march, {"samples": 7, "capacity": 40, "most": 5}),
    "update_occupancy": (
        lambda n: {"density": torch.rand(2, 3, 4), "cells": index(n, 24), "values": torch.rand(n)},
        {"decay": 0.5, "threshold": 0.4},
    ),
    "resample": (
        lambda n: {"weights": torch.rand(n, 5), "edges": torch.rand(n, 6).cumsum(1), "uniforms": torch.rand(n, 8)},
        {"count": 8},
    ),
    "resample, even": (lambda n: {"weights": torch.rand(n, 5), "edges": torch.rand(n, 6).cumsum(1)}, {"count": 8}),
    "composite": (rays, {}),
    "composite, packed": (packed, {}),
    "frequency_encode": (lambda n: {"x": torch.rand(n, 3)}, {"octaves": 4}),
    "frequency_encode, itself": (lambda n: {"x": torch.rand(n, 3)}, {"octaves": 0}),
    "frequency_encode, nothing": (lambda n: {"x": torch.rand(n, 3)}, {"octaves": 0, "include_input": False}),
    "integrated_encode": (lambda n: {"means": torch.rand(n, 3), "variances": torch.rand(n, 3)}, {"octaves": 3}),
    "spherical_harmonics": (lambda n: {"directions": torch.randn(n, 3)}, {"degree": 4}),
    "spherical_harmonics, constant": (lambda n: {"directions": torch.randn(n, 3)}, {"degree": 1}),
    "hash_encode": (
        lambda n: {"positions": torch.rand(n, 3), "table": torch.randn(HASHED.table_shape)},
        {"grid": HASHED},
    ),
    "hash_encode, of cells": (
        lambda n: {"positions": torch.rand(n, 3), "table": torch.randn(2, *HASHED.table_shape), "cells": index(n, 2)},
        {"grid": HASHED},
    ),
    "grouped_linear": (
        lambda n: {
            "x": torch.randn(n, 7),
            "offsets": offsets_of([n - 5, 0, 5]),
            "weight": torch.randn(3, 5, 7),
            "bias": torch.randn(3, 5),
        },
        {"activation": "sigmoid"},
    ),
    "grouped_mlp": (lambda n: {**network(n), "offsets": offsets_of([n - 5, 5])}, {"layers": NETWORK}),
    "grouped_mlp, integrated": (
        lambda n: {**network(n, GAUSSIANS), "offsets": offsets_of([n - 5, 5])},
        {"layers": GAUSSIANS},
    ),
    "grouped_mlp, hashed": (
        lambda n: {
            **network(n, GRIDDED),
            "features": torch.randn(EIGHT.table_shape),
            "offsets": offsets_of([n - 5, 5]),
        },
        {"layers": GRIDDED},
    ),
    "routed_mlp": (lambda n: {**network(n), "centres": torch.rand(2, 3)}, {"layers": NETWORK}),
    "routed_mlp, nested": (lambda n: {**network(n, k=7), **TREE}, {"layers": NETWORK, "depth": 3}),
    "routed_mlp, one cell": (lambda n: network(n, GAUSSIANS, k=1), {"layers": GAUSSIANS}),
    "routed_mlp, of cells": (lambda n: {**network(n), "cells": index(n, 2)}, {"layers": NETWORK}),
}
RUNS = [
    (name, backend, device)
    for name in CASES
    for backend in backends.implemented(name.split(",")[0])
    for device in ("cpu", "cuda")
]
every_op = pytest.mark.parametrize(
    ("name", "backend", "device"), RUNS, indirect=["device"], ids=["-".join(run) for run in RUNS]
)


def prepare(name, backend, device):
    """The op as a function of its tensors, and a maker of those."""
    op, (make, options) = name.split(",")[0], CASES[name]
    need(op, backend, device, torch.int32 if op == "cell_sort" else torch.float32)

    def ready(tensor):
        # Warp's camera rays have no gradients.
        return tensor.to(device).detach().requires_grad_(tensor.is_floating_point() and op != "camera_rays")

    return lambda given: getattr(ops, op)(**given, **options, backend=backend), lambda n: tree_map_only(
        Tensor, ready, make(n)
    )


def results(run, given):
    """What an op gives, and the gradients of its outputs if it has any."""
    found = [part for part in tree_leaves(run(given)) if isinstance(part, Tensor)]
    leaves = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor) and leaf.requires_grad]
    smooth = [part for part in found if part.requires_grad]
    if smooth:
        total = sum(part.square().sum() for part in smooth)
        found += torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
    return found


def assert_close(found, expected):
    for part, other in zip(found, expected, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-4, atol=1e-5)


@every_op
def test_compiles_for_any_size(device, backend, name):
    if (name, backend) == ("cast_solids", "reference"):
        pytest.skip("is not compiled whole")
    torch.compiler.reset()
    run, tensors = prepare(name, backend, device)
    # The reference consists of torch's own operations, whose gradients are torch's to trace.
    compiled = torch.compile(run, fullgraph=True, backend="eager" if backend == "reference" else "aot_eager")
    for n in (9, 14):
        given = tensors(n)
        assert_close(results(compiled, given), results(run, given))


def columns(tensor):
    """The same values, column by column in memory where there are any."""
    return tensor.mT.contiguous().mT if tensor.dim() > 1 else tensor


def negated(tensor):
    """The same values in a view with the negative bit, as ``.conj().imag`` gives; memory holds them negated."""
    return torch._neg_view(-tensor) if tensor.is_floating_point() else tensor


@every_op
def test_any_view(device, backend, name):
    """Values count, and not how memory holds them."""
    run, tensors = prepare(name, backend, device)
    given = tensors(33)
    expected = results(run, given)
    for form in (strided, columns, negated):
        spread = lambda tensor, form=form: form(tensor.detach()).requires_grad_(tensor.requires_grad)  # noqa: E731
        assert_close(results(run, tree_map_only(Tensor, spread, given)), expected)


class Calls(TorchFunctionMode):
    """Notes the custom ops of the library that are called, and once for each kind of arguments what with."""

    def __init__(self):
        super().__init__()
        self.found = {}

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if isinstance(function, torch._ops.OpOverload) and function.namespace == "voronerf":
            # An op that is called where nothing is recorded need not be differentiable.
            held = args if torch.is_grad_enabled() else tree_map_only(Tensor, Tensor.detach, args)
            kinds = [leaf.requires_grad if isinstance(leaf, Tensor) else leaf is None for leaf in tree_leaves(held)]
            self.found[function, str(kinds)] = (function, held)
        return function(*args, **(kwargs or {}))


@every_op
def test_custom_ops_pass_opcheck(device, backend, name):
    """Those that its values call, its gradients, and its second derivatives."""
    if backend == "reference":
        pytest.skip("has none")
    run, tensors = prepare(name, backend, device)
    given = tensors(6)
    leaves = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor) and leaf.requires_grad]
    with Calls() as calls:
        results(run, given)
        for power in (1, 2):  # in a plain sum the gradients that arrive are constant
            smooth = [part for part in tree_leaves(run(given)) if isinstance(part, Tensor) and part.requires_grad]
            if smooth:
                total = sum(part.pow(power).sum() for part in smooth)
                options = {"create_graph": True, "allow_unused": True, "materialize_grads": True}
                bent = [first for first in torch.autograd.grad(total, leaves, **options) if first.requires_grad]
                torch.autograd.backward([first.square().sum() for first in bent])
    assert calls.found
    for function, args in calls.found.values():
        torch.library.opcheck(function, args)
