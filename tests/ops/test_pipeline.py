"""All operations in sequence, as a renderer calls them."""

from __future__ import annotations

import shutil

import pytest
import torch
import torch._inductor.config as inductor

from voronerf.ops import cell_sort, composite, grouped_mlp, nearest_centre, resample
from voronerf.ops._core.layers import DIRECTIONS, MLP, POSITIONS, Layer

TABLE = MLP(
    (
        Layer((POSITIONS,), 16, "relu"),
        Layer((0, POSITIONS), 16, "relu"),
        Layer((1,), 1, "softplus"),
        Layer((1, DIRECTIONS), 3, "sigmoid"),
    ),
    outputs=(3, 2),
    position_octaves=4,
    direction_octaves=2,
)
RAYS, SAMPLES, CELLS = 12, 8, 5


def inputs(device):
    weights = [torch.randn(CELLS, o, i) / i**0.5 for o, i in TABLE.weight_shapes(3, 3)]
    tensors = [torch.randn(RAYS, 3), torch.nn.functional.normalize(torch.randn(RAYS, 3), dim=1), torch.randn(CELLS, 3)]
    return [tensor.to(device).requires_grad_(index > 2) for index, tensor in enumerate([*tensors, *weights])]


def render(origins, directions, centres, *weights):
    edges = torch.linspace(0, 2, SAMPLES + 1, device=origins.device).expand(RAYS, -1)
    depths = resample(torch.ones_like(edges[:, 1:]), edges, SAMPLES)
    points = (origins[:, None] + depths[..., None] * directions[:, None]).flatten(0, 1)
    order, offsets = cell_sort(nearest_centre(points, centres), CELLS)
    ray = torch.arange(RAYS, dtype=torch.int32, device=origins.device).repeat_interleave(SAMPLES)
    sorted_out = grouped_mlp(
        points[order],
        offsets,
        weights,
        [None] * len(weights),
        layers=TABLE,
        directions=directions,
        direction_index=ray[order],
    )
    out = torch.empty_like(sorted_out).index_copy(0, order.long(), sorted_out).unflatten(0, (RAYS, SAMPLES))
    deltas = edges.diff(dim=1)
    return composite(out[..., 3], out[..., :3], depths, deltas, background=origins.new_ones(3)).colour


@pytest.mark.parametrize("compiler", ["aot_eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_compiles_as_one_graph(device, compiler):
    if compiler == "inductor" and not any(shutil.which(name) for name in ("c++", "g++", "clang++")):
        pytest.skip("torch.compile finds no C++ compiler")
    leaves = inputs(device)
    expected = render(*leaves)
    with inductor.patch({"cpp.vec_isa_ok": False}):  # the check of vector instructions takes two compilations
        actual = torch.compile(render, fullgraph=True, backend=compiler)(*leaves)
    torch.testing.assert_close(actual, expected, rtol=1e-4, atol=1e-5)
    for gradient, other in zip(*(torch.autograd.grad(y.square().sum(), leaves[3:]) for y in (actual, expected))):
        torch.testing.assert_close(gradient, other, rtol=1e-3, atol=1e-5)
