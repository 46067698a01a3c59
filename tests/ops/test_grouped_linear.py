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

WIDTHS = [(1, 1), (63, 64), (90, 3), (3, 90)]


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


@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("counts", COUNTS.values(), ids=COUNTS)
def test_output_and_gradients_match_a_plain_loop(device, backend, counts, activation):
    inputs, offsets = layer(counts, 17, 9), offsets_of(counts)
    g = torch.randn(sum(counts), 9)
    exact = results(loops.grouped_linear, inputs, offsets, torch.float64, torch.device("cpu"), g, activation=activation)
    if activation == "relu":
        # Two correct float32 results may fall on either side of the kink.
        g = g * (exact[0] == 0).logical_or(exact[0] > 1e-4)
    cpu = torch.device("cpu")
    exact = results(loops.grouped_linear, inputs, offsets, torch.float64, cpu, g, activation=activation)
    plain = results(loops.grouped_linear, inputs, offsets, torch.float32, cpu, g, activation=activation)
    actual = results(grouped_linear, inputs, offsets, torch.float32, device, g, activation=activation, backend=backend)
    for part, same, right in zip(actual, plain, exact):
        assert_as_exact(part, same, right)


@pytest.mark.parametrize("dtype", FLOATS)
@pytest.mark.parametrize(("i", "o"), WIDTHS)
def test_dtypes_and_widths(device, backend, i, o, dtype):
    need("grouped_linear", backend, device, dtype)
    counts = COUNTS["odd"]
    inputs, offsets, g = layer(counts, i, o, dtype), offsets_of(counts), torch.randn(sum(counts), o).to(dtype)
    cpu = torch.device("cpu")
    exact = results(loops.grouped_linear, inputs, offsets, torch.float64, cpu, g)
    plain = results(loops.grouped_linear, inputs, offsets, dtype, cpu, g)
    actual = results(grouped_linear, inputs, offsets, dtype, device, g, backend=backend)
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


def test_without_bias(device, backend):
    counts = COUNTS["odd"]
    x, weight, _ = (tensor.to(device) for tensor in layer(counts, 5, 4))
    offsets = offsets_of(counts, device)
    actual = grouped_linear(x, offsets, weight, backend=backend)
    expected = grouped_linear(x, offsets, weight, torch.zeros(len(counts), 4, device=device), backend=backend)
    torch.testing.assert_close(actual, expected)


def test_rows_of_no_cell_are_zero(device, backend):
    x, weight, bias = (tensor.to(device).requires_grad_() for tensor in layer([3, 4, 5], 4, 2))
    offsets = torch.tensor([2, 5, 9], dtype=torch.int32, device=device)
    y = grouped_linear(x, offsets, weight[:2], bias[:2], activation="sigmoid", backend=backend)
    assert (y[:2] == 0).all() and (y[9:] == 0).all() and (y[2:9] != 0).all()
    y.sum().backward()
    assert (x.grad[:2] == 0).all() and (x.grad[9:] == 0).all() and (x.grad[2:9] != 0).any()


def test_what_is_not_a_number_stays_in_its_cell(device, backend):
    counts = [4, 5, 6]
    x, weight, bias = (tensor.to(device) for tensor in layer(counts, 4, 3))
    x[6, 2], weight[1, 0, 1] = torch.nan, torch.inf
    leaves = [tensor.requires_grad_() for tensor in (x, weight, bias)]
    y = grouped_linear(leaves[0], offsets_of(counts, device), *leaves[1:], backend=backend)
    y.sum().backward()
    rows = [*range(4), *range(9, 15)]
    assert y[rows].isfinite().all() and x.grad[rows].isfinite().all()
    assert weight.grad[[0, 2]].isfinite().all() and bias.grad.isfinite().all()
    assert not y[6].isfinite().any()


@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_second_derivatives_match_a_plain_loop(device, backend, activation):
    counts = COUNTS["odd"]
    offsets = offsets_of(counts)
    inputs = layer(counts, 4, 3)

    def penalty(linear, device, dtype, **options):
        leaves = [tensor.to(device, dtype).requires_grad_() for tensor in inputs]
        y = linear(leaves[0], offsets.to(device), *leaves[1:], activation=activation, **options)
        slopes = torch.autograd.grad(y.square().sum(), leaves, create_graph=True)
        return [
            grad for slope in slopes for grad in torch.autograd.grad(slope.square().sum(), leaves, retain_graph=True)
        ]

    exact = penalty(loops.grouped_linear, torch.device("cpu"), torch.float64)
    plain = penalty(loops.grouped_linear, torch.device("cpu"), torch.float32)
    for part, same, right in zip(penalty(grouped_linear, device, torch.float32, backend=backend), plain, exact):
        assert_as_exact(part, same, right)


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
