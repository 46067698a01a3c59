from __future__ import annotations

import math

import pytest
import torch
from op_cases import refused, strided

from voronerf import native
from voronerf.ops import sparse_adam

pytestmark = pytest.mark.op("sparse_adam")


def table(shape, share, seed=0):
    """A parameter, its gradient, of which a share is not zero, and both moments."""
    generator = torch.Generator().manual_seed(seed)
    parameter, gradient, mean = (torch.randn(shape, generator=generator) for _ in range(3))
    gradient *= torch.rand(shape, generator=generator) < share
    return parameter, gradient, mean, torch.rand(shape, generator=generator)


def loop(parameter, gradient, mean, square, step, rate, betas, epsilon):
    """Kingma and Ba 2015, algorithm 1, one entry at a time in float64."""
    p, g, m, v = (t.double().flatten().tolist() for t in (parameter, gradient, mean, square))
    for i in range(len(p)):
        if g[i] != 0:
            m[i] = betas[0] * m[i] + (1 - betas[0]) * g[i]
            v[i] = betas[1] * v[i] + (1 - betas[1]) * g[i] ** 2
            corrected = math.sqrt(v[i] / (1 - betas[1] ** step))
            p[i] -= rate * m[i] / (1 - betas[0] ** step) / (corrected + epsilon)
    return [torch.tensor(t, dtype=torch.float64).reshape(parameter.shape) for t in (p, m, v)]


@pytest.mark.parametrize("shape", [(0, 2), (1,), (15,), (17, 1), (331, 2), (4, 33, 8)])
@pytest.mark.parametrize("share", [0.0, 0.05, 1.0])
def test_equals_a_slow_loop(device, backend, shape, share):
    given = table(shape, share)
    found = [t.to(device).clone() for t in given]
    rule = {"step": 3, "learning_rate": 0.01, "betas": (0.9, 0.99), "epsilon": 1e-10}
    sparse_adam(*found, **rule, backend=backend)
    expected = loop(*given, 3, 0.01, (0.9, 0.99), 1e-10)
    untouched = given[1] == 0
    for result, wanted, before in zip((found[0], *found[2:]), expected, (given[0], *given[2:]), strict=True):
        torch.testing.assert_close(result.cpu().double(), wanted, rtol=1e-5, atol=1e-6)
        assert torch.equal(result.cpu()[untouched], before[untouched])
    assert torch.equal(found[1].cpu(), given[1])


def test_gradients_of_minus_zero_are_none_and_nan_spreads(device, backend):
    found = [t.to(device) for t in table((40,), 1.0)]
    before = [t.clone() for t in found]
    found[1].fill_(-0.0)
    found[1][5] = torch.nan
    sparse_adam(*found, step=1, learning_rate=0.1, backend=backend)
    for now, then in zip((found[0], *found[2:]), (before[0], *before[2:]), strict=True):
        assert bool(now[5].isnan())
        now[5] = then[5]
        assert torch.equal(now, then)


def test_a_gradient_may_be_strided(device, backend):
    given = [t.to(device) for t in table((37, 3), 0.5)]
    one, other = [t.clone() for t in given], [t.clone() for t in given]
    other[1] = strided(other[1])
    for tensors in (one, other):
        sparse_adam(*tensors, step=2, learning_rate=0.1, backend=backend)
    assert all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.native
def test_native_bits_depend_neither_on_threads_nor_on_instructions():
    given, results, threads = table((70_001,), 0.1), [], torch.get_num_threads()
    try:
        for isa in native.SUPPORTED_ISAS:
            for count in (1, 3):
                torch.set_num_threads(count)
                found = [t.clone() for t in given]
                with native.using_isa(isa):
                    sparse_adam(*found, step=7, learning_rate=0.01, backend="native")
                results.append(found)
    finally:
        torch.set_num_threads(threads)
    for found in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found, results[0], strict=True))


def test_refuses_what_makes_no_sense():
    p, g, m, v = table((4, 2), 1.0)
    rule = {"step": 1, "learning_rate": 0.1}
    with refused(ValueError, "sparse_adam: gradient must have shape [4, 2], got [3, 2]"):
        sparse_adam(p, g[:3], m, v, **rule)
    with refused(ValueError, "sparse_adam: mean must be contiguous, got strides (1, 4)"):
        sparse_adam(p, g, m.t().contiguous().t(), v, **rule)
    with refused(TypeError, "sparse_adam: square must have dtype float32, got float64"):
        sparse_adam(p, g, m, v.double(), **rule)
    with refused(ValueError, "sparse_adam: step must be at least 1, got 0"):
        sparse_adam(p, g, m, v, step=0, learning_rate=0.1)
    with refused(ValueError, "sparse_adam: betas must lie in [0, 1), got (0.9, 1.0)"):
        sparse_adam(p, g, m, v, **rule, betas=(0.9, 1.0))
    for betas in (0.9, (0.9,), "ab", {0.9, 0.99}):
        with refused(TypeError, "sparse_adam: betas must be a pair of numbers, got ..."):
            sparse_adam(p, g, m, v, **rule, betas=betas)
    with refused(TypeError, "sparse_adam: betas must be a number, got Tensor"):
        sparse_adam(p, g, m, v, **rule, betas=(0.9, torch.tensor(0.9)))
    with refused(ValueError, "sparse_adam: square must be a tensor of its own (clone), got a negative view"):
        sparse_adam(p, g, m, torch._neg_view(v), **rule)
    with refused(ValueError, "sparse_adam: epsilon must be positive, got 0.0"):
        sparse_adam(p, g, m, v, **rule, epsilon=0.0)
