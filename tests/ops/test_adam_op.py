"""Adam of several parameters in one operation."""

from __future__ import annotations

import pytest
import torch
from adam_steps import assert_adam
from op_cases import refused

from voronerf.ops import Guard, Rule, adam

pytestmark = pytest.mark.op("adam")


@pytest.mark.parametrize("count", [1, 5])
def test_equals_the_formula(device, backend, count):
    assert_adam(count, device=device, backend=backend)
    assert_adam(count, device=device, backend=backend, scale=torch.tensor(1024.0), rate=torch.tensor(0.01))


@pytest.mark.parametrize("spoilt", ["loss", 0, 2])
def test_leaves_out_a_step_that_is_not_finite(device, backend, spoilt):
    assert_adam(3, device=device, backend=backend, spoilt=spoilt)
    assert_adam(3, device=device, backend=backend, spoilt=spoilt, limit=torch.inf if spoilt == "loss" else 1e3)


def test_a_table_may_have_any_gradient(device, backend):
    """Its entries are not read to judge a step: they are products of gradients that are."""
    table = [torch.ones(4, device=device) for _ in range(4)]
    table[1][2] = torch.nan
    guard, step = Guard.on(device, skipped=3), torch.zeros((), device=device)
    given = [[tensor] for tensor in table]
    adam([Rule(step, 0.1, every=False)], *given, guard=guard, loss=step + 1, backend=backend)
    assert float(step) == 1 and float(guard.skipped) == 3 and float(guard.found) == 0


def test_what_was_found_before_leaves_out_a_step(device, backend):
    tensors = [[torch.ones(40, device=device)] for _ in range(4)]
    for found in (1.0, 0.0):
        guard, step = Guard(*torch.full((3,), found, device=device)), torch.zeros((), device=device)
        adam([Rule(step, 0.1)], *tensors, guard=guard, backend=backend)
        assert float(step) == 1 - found and bool((tensors[0][0] == 1).all()) == (found == 1)


def test_refuses_what_would_be_read_out_of_bounds():
    """Each on its own: a fast pass over all tensors decides whether they are looked at one by one."""

    def call(rules=None, **changed):
        given = {name: [torch.ones(())] for name in ("parameters", "gradients", "means", "squares")}
        adam(rules or [Rule(torch.zeros(()), 0.1)], **{**given, **changed})

    call()
    rule = Rule(torch.zeros(()), 0.1)
    wrong = {
        "adam: gradient must have shape [], got [2]": {"gradients": [torch.ones(2)]},
        "adam: mean must have shape [], got [1]": {"means": [torch.ones(1)]},
        "adam: square must have shape [], got [0]": {"squares": [torch.ones(0)]},
        "adam: gradients must be as many as the 1 rules, got 2": {"gradients": 2 * [torch.ones(())]},
        "adam: parameters must be as many as the 1 rules, got 0": {"parameters": []},
        "adam: step must have shape [], got [1]": {"rules": [rule._replace(step=torch.zeros(1))]},
        "adam: loss must come with a guard, got none": {"loss": torch.ones(())},
        "adam: found must have shape [], got [3]": {"guard": Guard(*torch.ones(3, 3))},
        "adam: loss must have shape [], got [1]": {"guard": Guard.on("cpu"), "loss": torch.ones(1)},
        "adam: epsilon must be positive, got 0.0": {"rules": [rule._replace(epsilon=0.0)]},
        "adam: betas must lie in [0, 1), got (0.9, 1.0)": {"rules": [rule._replace(betas=(0.9, 1.0))]},
    }
    for message, changed in wrong.items():
        with refused(ValueError, message):
            call(**changed)
    for message, changed in {
        "adam: gradient must have dtype float32, got float64": {"gradients": [torch.ones((), dtype=torch.float64)]},
        "adam: parameter must be a tensor, got float": {"parameters": [1.0]},
        "adam: square must be a dense tensor, got a sparse_coo one": {"squares": [torch.ones(()).to_sparse()]},
        "adam: step must be a tensor, got int": {"rules": [rule._replace(step=1)]},
        "adam: rules must hold a Rule for each parameter, got tuple": {"rules": [tuple(rule)]},
        "adam: guard must be a Guard, got Tensor": {"guard": torch.ones(())},
        "adam: learning_rate must be a number, got str": {"rules": [rule._replace(learning_rate="x")]},
    }.items():
        with refused(TypeError, message):
            call(**changed)
    with refused(ValueError, "adam: parameter must be contiguous, got strides (1, 2)"):
        turned = torch.ones(3, 2).t()
        call(**{name: [turned] for name in ("parameters", "gradients", "means", "squares")})
    two = [rule, rule._replace(step=torch.zeros(()))]
    with refused(ValueError, "adam: gradient must have shape [4], got [3]"):
        lists = [[torch.ones(4), torch.ones(4)] for _ in range(4)]
        lists[1][1] = torch.ones(3)
        adam(two, *lists)
