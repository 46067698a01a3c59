from __future__ import annotations

import loops
import pytest
import torch
from op_cases import COUNTS, FLOATS, HALVES, need, offsets_of, refusals
from tolerances import assert_as_exact
from torch.utils._python_dispatch import TorchDispatchMode

from voronerf.ops import grouped_linear
from voronerf.ops._core.layers import ACTIVATIONS
from voronerf.ops._core.program import Program

pytestmark = pytest.mark.op("grouped_linear")

# Each activation, then cells of each size, then each width with each dtype.
CASES = [
    *(("odd", 17, 9, activation, torch.float32) for activation in ACTIVATIONS),
    *((counts, 17, 9, "sigmoid", torch.float32) for counts in COUNTS if counts != "odd"),
    *(("odd", i, o, "none", dtype) for i, o in [(1, 1), (63, 64), (90, 3), (3, 90)] for dtype in FLOATS),
]


def layer(counts, i, o, dtype=torch.float32):
    """Returns the samples, the weight and the bias for one layer."""
    k = len(counts)
    tensors = torch.randn(sum(counts), i), torch.randn(k, o, i) / i**0.5, torch.randn(k, o)
    return [tensor.to(dtype) for tensor in tensors]


def results(linear, inputs, offsets, dtype, device, g, **options):
    """Returns the output and the gradients, computed in a dtype on a device."""
    leaves = [tensor.to(device, dtype).requires_grad_() for tensor in inputs]
    x, weight, bias = leaves
    y = linear(x, offsets.to(device), weight, bias, **options)
    return [y, *torch.autograd.grad(y, leaves, g.to(device, dtype))]


@pytest.mark.parametrize(("counts", "i", "o", "activation", "dtype"), CASES)
def test_output_and_gradients_match_a_plain_loop(device, backend, counts, i, o, activation, dtype):
    need("grouped_linear", backend, device, dtype)
    counts, cpu, options = COUNTS[counts], torch.device("cpu"), {"activation": activation}
    inputs, offsets, g = layer(counts, i, o, dtype), offsets_of(counts), torch.randn(sum(counts), o).to(dtype)
    exact = results(loops.grouped_linear, inputs, offsets, torch.float64, cpu, g, **options)
    if activation == "relu":
        # Two correct float32 results may fall on either side of the kink.
        g = g * (exact[0] == 0).logical_or(exact[0] > 1e-4)
        exact = results(loops.grouped_linear, inputs, offsets, torch.float64, cpu, g, **options)
    plain = results(loops.grouped_linear, inputs, offsets, dtype, cpu, g, **options)
    actual = results(grouped_linear, inputs, offsets, dtype, device, g, **options, backend=backend)
    for part, same, right in zip(actual, plain, exact):
        assert_as_exact(part, same, right)


@pytest.mark.parametrize("dtype", HALVES)
def test_sums_over_many_samples_are_wide(device, backend, dtype):
    need("grouped_linear", backend, device, dtype)
    n = 9000
    weight = torch.zeros(1, 1, 1, dtype=dtype, device=device, requires_grad=True)
    bias = torch.zeros(1, 1, dtype=dtype, device=device, requires_grad=True)
    x = torch.ones(n, 1, dtype=dtype, device=device)
    y = grouped_linear(x, offsets_of([n], device), weight, bias, backend=backend)
    y.backward(torch.ones_like(y))
    # A sum of ones in a half type would stop growing at 256 or 2,048.
    assert weight.grad.item() == bias.grad.item() == torch.tensor(float(n), dtype=dtype).item()


@pytest.mark.native
def test_gradients_that_nobody_asked_for_are_not_computed():
    class Watch(TorchDispatchMode):
        def __torch_dispatch__(self, function, types, arguments=(), options=None):
            if function is torch.ops.voronerf.network.default:
                program = Program.parse(arguments[6])
                wanted.append([step.op for step in program.steps if step.op in ("linear", "outer", "columns")])
            return function(*arguments, **(options or {}))

    wanted = []
    x, weight, bias = (tensor.requires_grad_() for tensor in layer([3, 4], 4, 3))
    y = grouped_linear(x, offsets_of([3, 4]), weight, bias, backend="native")
    with Watch():
        (slope,) = torch.autograd.grad(y.sum(), x, create_graph=True)
        torch.autograd.grad(slope.square().sum(), weight, retain_graph=True)
        assert wanted == [["linear"], ["outer"]]


def test_errors():
    x, weight, _ = layer([2, 3], 4, 5)
    offsets = offsets_of([2, 3])
    refuses = refusals(grouped_linear, x=x, offsets=offsets, weight=weight)
    refuses("weight must have no empty dimension, got [2, 0, 4]", weight=weight[:, :0])
    refuses("activation must be one of none, relu, ..., sine, got 'tanh'", activation="tanh")
