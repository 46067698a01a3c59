"""Tests of networks on CUDA with values near and above float16's largest number: no NaN where float32 has none.

The tests cover every activation, with values in shared memory and in the workspace. Values are clamped to 65,504
when a layer reads them. Gradients overflow to infinity, which a GradScaler detects. Other samples and cells keep their
precision.
"""

import pytest
import torch
from emulated import emulated
from emulated_networks import KIB

import voronerf
from voronerf.ops._core.layers import ACTIVATIONS, MLP, POSITIONS, Layer

LARGEST = 65504.0
WAYS = pytest.mark.parametrize("shared", [227, 12], ids=["tiles", "workspace"])
ROWS, CELLS = 40, 2


def network(activation):
    """Returns a layer with large values, a layer that reads them, and the outputs of both."""
    return MLP((Layer((POSITIONS,), 16, activation), Layer((0,), 16, activation), Layer((1,), 3)), (2, 0))


def given(layers, size):
    """Draws positions, and weights and biases that float16 represents exactly.

    In an eighth of the rows, the first layer's values have magnitude ``size``, positive in half of the columns. In the
    other rows they have magnitude 1."""
    torch.manual_seed(1)
    positions = torch.ones(ROWS, 3) / 4
    positions[::8, 0] = size
    shapes = layers.weight_shapes(3, 0)
    weights = [torch.randn(CELLS, o, i) / i**0.5 for o, i in shapes]
    weights[0][:, :, 0] = torch.tensor([1.0, -1.0]).repeat(8)
    # Later layers scale the large values down.
    parameters = [weights[0], *(weight / 64 for weight in weights[1:]), *(torch.zeros(CELLS, o) for o, _ in shapes)]
    return [positions, *(parameter.half().float() for parameter in parameters)]


def outcome(layers, parts, dtype, backend, scale=1.0):
    """Returns the output and the gradients of positions, weights and biases, for an output gradient of ``scale``.

    As in training, parameters are float32 and autocast computes in float16."""
    leaves = [part.to(dtype).requires_grad_() for part in parts]
    count, offsets = len(layers.layers), torch.tensor([0, 23, ROWS], dtype=torch.int32)
    with torch.autocast("cpu", torch.float16, enabled=backend == "native"):
        parameters = leaves[1 : 1 + count], leaves[1 + count :]
        out = voronerf.grouped_mlp(leaves[0], offsets, *parameters, layers=layers, backend=backend)
    return [out, *torch.autograd.grad(out, leaves, torch.full_like(out, scale))]


def run(layers, parts, shared, scale=1.0):
    with emulated(shared_bytes=shared * KIB):
        return outcome(layers, parts, torch.float32, "native", scale)


@WAYS
@pytest.mark.parametrize("activation", ACTIVATIONS)
@pytest.mark.parametrize("size", [LARGEST - 32, 65519.0, 65520.0, 1e30])
def test_values_up_to_the_limit_are_exact_and_those_beyond_cut_off(activation, size, shared):
    """Checks values around 65,520, where float16 rounds to infinity: no NaN, and small values stay exact.

    Later layers read larger values as the largest number.
    """
    layers = network(activation)
    parts = given(layers, size)
    found, right = run(layers, parts, shared), outcome(layers, parts, torch.float32, "reference")
    assert all(part.isfinite().all() for part in right) and not any(part.isnan().any() for part in found)
    usual = torch.arange(ROWS) % 8 != 0
    for part, expected in zip(found[:2], right):
        torch.testing.assert_close(part[usual].float(), expected[usual], rtol=5e-3, atol=5e-3)
    if size < LARGEST and activation != "sine":  # a sine of such an angle has no correct digits
        for part, exact in zip(found, outcome(layers, parts, torch.float64, "reference")):
            assert part.isfinite().all()
            assert (part.double() - exact).norm() <= 4e-3 * exact.norm() + 1e-5, list(part.shape)
    elif activation != "sine":
        largest = outcome(layers, given(layers, LARGEST), torch.float32, "reference")[0][:, :3]
        torch.testing.assert_close(found[0][:, :3].float(), largest, rtol=4e-3, atol=4e-3)


@WAYS
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_gradients_of_a_scaled_loss(activation, shared):
    """Checks that loss scales of powers of 2 give the same gradients, or gradients that are not finite on overflow."""
    layers = network(activation)
    parts = given(layers, 1.0)
    plain = run(layers, parts, shared)[1:]
    for scale in (2.0**-4, 2.0**10):
        for part, unscaled in zip(run(layers, parts, shared, scale)[1:], plain):
            torch.testing.assert_close(part / scale, unscaled, rtol=2e-3, atol=2e-3 * float(unscaled.abs().max()))
    parts[3] = parts[3] * 2.0**12  # the weights of the last layer
    out, _, first, _, last, *_ = run(layers, parts, shared, 2.0**15)
    assert out.isfinite().all() and last.isfinite().all() and not first.isfinite().all()
