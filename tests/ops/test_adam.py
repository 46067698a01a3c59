"""Adam of several parameters in one operation."""

from __future__ import annotations

import math
import re

import pytest
import torch
from adam_steps import assert_adam
from op_cases import refused, strided

from voronerf.ops import Guard, UpdateRule, adam, average
from voronerf.ops._core import native

pytestmark = pytest.mark.op("adam")


@pytest.mark.parametrize("count", [1, 5])
def test_equals_the_formula(device, backend, count):
    assert_adam(count, device=device, backend=backend)
    assert_adam(count, device=device, backend=backend, scale=torch.tensor(1024.0), rate=torch.tensor(0.01))


@pytest.mark.parametrize("spoilt", ["loss", 0, 2])
def test_leaves_out_a_step_that_is_not_finite(device, backend, spoilt):
    assert_adam(3, device=device, backend=backend, spoilt=spoilt)
    assert_adam(3, device=device, backend=backend, spoilt=spoilt, limit=torch.inf if spoilt == "loss" else 1e3)


def test_leaves_out_a_step_wherever_a_gradient_is_not_finite(device, backend):
    """The NaN is put next to block borders; on CUDA one pass takes 127 blocks of 4,096 entries."""
    sizes, judged = [3, 90, 530_001, 0, 4097], [True, False, True, True, True]
    tensors = [[torch.ones(n, device=device) for n in sizes] for _ in range(4)]
    gradients, guard = tensors[1], Guard.on(device)
    rules = [UpdateRule(torch.zeros((), device=device), 0.1, dense=every) for every in judged]
    places = [(0, 2), (2, 0), (2, 4095), (2, 4096), (2, 127 * 4096), (2, 530_000), (4, 0), (4, 4096)]
    for number, (which, place) in enumerate(places):
        gradients[which][place] = torch.nan
        adam(rules, *tensors, guard=guard, loss=guard.skip + 1, backend=backend)
        assert bool(guard.skip) and float(guard.in_a_row) == float(guard.skipped) == number + 1
        assert all(bool((parameter == 1).all()) for parameter in tensors[0]) and not any(rule.step for rule in rules)
        gradients[which][place] = 1
    gradients[1][89] = torch.nan  # the gradient of a table, which is not checked
    adam(rules, *tensors, guard=guard, loss=guard.skip + 1, backend=backend)
    assert not guard.skip and not guard.in_a_row and float(guard.skipped) == len(places)
    assert all(bool((parameter != 1).all()) and rule.step for parameter, rule in zip(tensors[0], rules, strict=True))


def test_decay_rates_near_1(device, backend):
    parameter, step = torch.ones(64, device=device), torch.zeros((), device=device)
    exact = torch.ones(64, device=device, requires_grad=True)
    betas, moments = (0.9, 0.9999999), [torch.zeros(64, device=device) for _ in range(2)]
    theirs = torch.optim.Adam([exact], 0.01, betas)
    for number in range(3):
        exact.grad = torch.linspace(0.5, 1, 64, device=device) + number
        rule = UpdateRule(step, 0.01, betas=betas)
        adam([rule], [parameter], [exact.grad], *([moment] for moment in moments), backend=backend)
        theirs.step()
    torch.testing.assert_close(parameter, exact.detach(), rtol=1e-5, atol=0)


@pytest.mark.op("average")
def test_the_whole_share_is_a_copy(device, backend):
    averages, parameters = ([torch.full((40,), value, device=device)] for value in (1e8, 1.5))
    average(averages, parameters, 1.0, backend=backend)
    assert torch.equal(averages[0], parameters[0])


def test_a_table_may_have_any_gradient(device, backend):
    """The gradient of a table is not checked, since its entries are products of checked gradients."""
    table = [torch.ones(4, device=device) for _ in range(4)]
    table[1][2] = torch.nan
    guard, step = Guard.on(device), torch.zeros((), device=device)
    guard.begin(3)
    arguments = [[tensor] for tensor in table]
    adam([UpdateRule(step, 0.1, dense=False)], *arguments, guard=guard, loss=step + 1, backend=backend)
    assert float(step) == 1 and float(guard.skipped) == 3 and float(guard.skip) == 0


def test_what_was_found_before_leaves_out_a_step(device, backend):
    tensors = [[torch.ones(40, device=device)] for _ in range(4)]
    for found in (1.0, 0.0):
        guard, step = Guard(*torch.full((3,), found, device=device)), torch.zeros((), device=device)
        adam([UpdateRule(step, 0.1)], *tensors, guard=guard, backend=backend)
        assert float(step) == 1 - found and bool((tensors[0][0] == 1).all()) == (found == 1)


def test_refuses_what_would_be_read_out_of_bounds(backend):
    """Each call has a single wrong argument."""
    names = ("parameters", "gradients", "means", "squares")

    def call(rules=None, **changed):
        arguments = {name: [torch.ones(())] for name in names}
        adam(rules or [UpdateRule(torch.zeros(()), 0.1)], **{**arguments, **changed}, backend=backend)

    call()
    rule, one, loss = UpdateRule(torch.zeros(()), 0.1), torch.ones(()), {"loss": torch.ones(())}
    wrong = {
        "gradient must have shape [], got [2]": {"gradients": [torch.ones(2)]},
        "mean must have shape [], got [1]": {"means": [torch.ones(1)]},
        "square must have shape [], got [0]": {"squares": [torch.ones(0)]},
        "gradients must have length 1 like rules, got 2": {"gradients": 2 * [one]},
        "parameters must have length 1 like rules, got 0": {"parameters": []},
        "step must have shape [], got [1]": {"rules": [rule._replace(step=torch.zeros(1))]},
        "step must have shape [], got [0]": {"rules": [rule._replace(step=torch.zeros(0))]},
        "learning_rate must have shape [], got [0]": {"rules": [rule._replace(learning_rate=torch.ones(0))]},
        "skip must have shape [], got [3]": {"guard": Guard(*torch.ones(3, 3))},
        "skipped must have shape [], got [0]": {"guard": Guard(one, *[torch.ones(0)] * 2), **loss},
        "loss must have shape [], got [1]": {"guard": Guard.on("cpu"), "loss": torch.ones(1)},
        "epsilon must be positive, got 0.0": {"rules": [rule._replace(epsilon=0.0)]},
        "betas must lie in [0, 1), got (0.9, 1.0)": {"rules": [rule._replace(betas=(0.9, 1.0))]},
        "square must not be a negative view: clone it": {"squares": [torch._neg_view(one)]},
        "gradient must have dtype float32, got float64": {"gradients": [one.double()]},
        "parameter must be a tensor, got float": {"parameters": [1.0]},
        "square must be a dense tensor, got a sparse_coo one": {"squares": [one.to_sparse()]},
        "step must be a tensor, got int": {"rules": [rule._replace(step=1)]},
        "step must be a dense tensor, got a sparse_coo one": {"rules": [rule._replace(step=one.to_sparse())]},
        "skip must be a tensor, got NoneType": {"guard": Guard(None, None, None), **loss},
        "rules[0] must be a UpdateRule, got tuple": {"rules": [tuple(rule)]},
        "guard must be a Guard, got Tensor": {"guard": one},
        "dense must be True or False, got int": {"rules": [rule._replace(dense=1)]},
        "learning_rate must be a number, got str": {"rules": [rule._replace(learning_rate="x")]},
        "betas must be a number, got Tensor": {"rules": [rule._replace(betas=(0.9, torch.tensor(0.9)))]},
        **{
            f"betas must be a pair of numbers, got {betas!r}": {"rules": [rule._replace(betas=betas)]}
            for betas in (0.9, (0.9,), "ab")
        },
        "parameter must be contiguous, got strides (1, 2)": {name: [torch.ones(3, 2).t()] for name in names},
        "gradient must have shape [4], got [3]": {
            "rules": [rule, rule._replace(step=torch.zeros(()))],
            **{name: [torch.ones(4), torch.ones(4)] for name in names},
            "gradients": [torch.ones(4), torch.ones(3)],
        },
    }
    for message, changed in wrong.items():
        with refused(TypeError if re.search("dtype|must be (a |True)", message) else ValueError, f"adam: {message}"):
            call(**changed)


# --- entries without a gradient are left unchanged -----------------------------------------------------------------


def table(shape, share, seed=0):
    """Returns a parameter, its gradient with the fraction ``share`` of nonzero entries, and both moments."""
    generator = torch.Generator().manual_seed(seed)
    parameter, gradient, mean = (torch.randn(shape, generator=generator) for _ in range(3))
    gradient *= torch.rand(shape, generator=generator) < share
    return parameter, gradient, mean, torch.rand(shape, generator=generator)


def loop(parameter, gradient, mean, square, step, rate, betas, epsilon):
    """Runs algorithm 1 of Kingma and Ba (2015), one entry at a time in float64."""
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
def test_a_table_equals_a_slow_loop(device, backend, shape, share):
    arguments = table(shape, share)
    actual = [t.to(device).clone() for t in arguments]
    rule = UpdateRule(torch.tensor(2.0, device=device), 0.01, (0.9, 0.99), 1e-10, dense=False)
    adam([rule], *([tensor] for tensor in (actual[0], strided(actual[1]), *actual[2:])), backend=backend)
    expected = loop(*arguments, 3, 0.01, (0.9, 0.99), 1e-10)
    untouched = arguments[1] == 0
    for result, wanted, before in zip((actual[0], *actual[2:]), expected, (arguments[0], *arguments[2:]), strict=True):
        torch.testing.assert_close(result.cpu().double(), wanted, rtol=1e-5, atol=1e-6)
        assert torch.equal(result.cpu()[untouched], before[untouched])
    assert torch.equal(actual[1].cpu(), arguments[1])


def test_gradients_of_minus_zero_are_none_and_nan_spreads(device, backend):
    tensors = [t.to(device) for t in table((40,), 1.0)]
    before = [t.clone() for t in tensors]
    tensors[1].fill_(-0.0)
    tensors[1][5] = torch.nan
    rule = UpdateRule(torch.zeros((), device=device), 0.1, dense=False)
    adam([rule], *([tensor] for tensor in tensors), backend=backend)
    for now, then in zip((tensors[0], *tensors[2:]), (before[0], *before[2:]), strict=True):
        assert bool(now[5].isnan())
        now[5] = then[5]
        assert torch.equal(now, then)


@pytest.mark.native
def test_native_bits_depend_neither_on_threads_nor_on_instructions():
    arguments, results, threads = table((70_001,), 0.1), [], torch.get_num_threads()
    try:
        for isa in native.SUPPORTED_ISAS:
            for count in (1, 3):
                torch.set_num_threads(count)
                tensors = [t.clone() for t in arguments]
                with native.using_isa(isa):
                    rule = UpdateRule(torch.tensor(6.0), 0.01, dense=False)
                    adam([rule], *([tensor] for tensor in tensors), backend="native")
                results.append(tensors)
    finally:
        torch.set_num_threads(threads)
    for tensors in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(tensors, results[0], strict=True))
