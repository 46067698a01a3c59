from __future__ import annotations

import re
from unittest import mock

import pytest
import torch
from cases import CASES, Draw
from op_cases import refused
from torch import Tensor

from voronerf import ops
from voronerf.ops._core import backends, checks
from voronerf.ops._core.checks import FLOATING, INDEX, LIKE_FIRST, TensorRule


def check(*rules):
    """Checks a tensor a [4, 3], then pairs of a rule and a tensor; returns the letters' sizes."""
    rows, tensors = zip((TensorRule("a", FLOATING, ("n", 3)), torch.zeros(4, 3)), *rules)
    return checks.check_rules("op", lambda: rows, [*tensors])


def test_rules_bind_letters():
    rules = TensorRule("b", LIKE_FIRST, ("n+1",)), TensorRule("c", LIKE_FIRST, ("1|m", 2), otherwise=("m",))
    for c, m in ((torch.zeros(1, 2), 0), (torch.zeros(5, 2), 5), (torch.zeros(7), 7)):
        assert check((rules[0], torch.zeros(5)), (rules[1], c)) == {"n": 4, "m": m}


def of(*shape, dtypes=FLOATING, **options):
    return TensorRule("x", dtypes, shape, **options)


@pytest.mark.parametrize(
    ("kind", "rule", "tensor", "message"),
    [
        (TypeError, of("n"), [1.0], "a tensor, got list"),
        (TypeError, of("n"), torch.zeros(4).to_sparse(), "a dense tensor, got a sparse_coo one"),
        (ValueError, of("k", 3), torch.zeros(8, 2), "shape [k, 3], got [8, 2]"),
        (ValueError, of("k", 3), torch.zeros(8), "shape [k, 3], got [8]"),
        (ValueError, of("n", 3), torch.zeros(3, 3), "shape [n, 3] with n = 4, got [3, 3]"),
        (ValueError, of("n+1"), torch.zeros(4), "shape [n+1] with n = 4, got [4]"),
        (ValueError, of("k+1"), torch.zeros(0), "shape [k+1], got [0]"),
        (ValueError, of("1|n", "n"), torch.zeros(1, 3), "shape [1, n] with n = 4, got [1, 3]"),
        (ValueError, of("k", "k"), torch.zeros(3, 2), "shape [k, k], got [3, 2]"),
        (ValueError, of("k+1", empty="must have an entry"), torch.zeros(1), "an entry, got [1]"),
        (ValueError, of("k"), torch.zeros(1).expand(2**31), "fewer than 2**31 rows, got 2147483648: split the batch"),
        (TypeError, of("n"), torch.zeros(4).long(), "dtype float16, bfloat16, float32 or float64, got int64"),
        (TypeError, of("n", dtypes=INDEX), torch.zeros(4).to(torch.complex64), "dtype int32, got complex64"),
        (TypeError, of("n", dtypes=LIKE_FIRST), torch.zeros(4).double(), "the dtype of a, float32, got float64"),
        (TypeError, of("n", dtypes=LIKE_FIRST, wide=True), torch.zeros(4).half(), "dtype float32, got float16"),
        (ValueError, of("n"), torch.zeros(4, device="meta"), "on the device of a, cpu, got meta"),
    ],
)
def test_a_broken_rule_is_named(kind, rule, tensor, message):
    verb = "be" if re.match("a |on ", message) else "have"
    with refused(kind, f"op: x must {verb} {message}"):
        check((rule, tensor))
    # Without the compiled module the error names the whole rule.
    with mock.patch.object(backends, "compiled", lambda: None), pytest.raises(kind, match=r"^op: x must be "):
        check((rule, tensor))


def test_a_subclass_is_checked_as_a_tensor():
    class Named(Tensor):
        pass

    tensors = [torch.ones(3, width).as_subclass(Named) for width in (2, 3)]
    with refused(ValueError, "nearest_centre: centres must have shape [k, d] with d = 2, got [3, 3]"):
        ops.nearest_centre(*tensors)
    assert ops.nearest_centre(tensors[0], tensors[0]).tolist() == [0, 0, 0]


def test_counts_and_integers():
    checks.check_count("op", "x", 2**31 - 1)
    with refused(ValueError, "op: k must be at least 1, got 0"):
        checks.check_integer("op", "k", 0, 1)
    for value in (1.0, True, "1"):
        with refused(TypeError, "op: k must be an integer, got ..."):
            checks.check_integer("op", "k", value, 1)
    with refused(ValueError, "op: a must be one of x, y, got 'z'"):
        checks.check_choice("op", "a", "z", ("x", "y"))


def test_a_batch_too_large_for_its_index_is_refused_before_it_is_touched():
    many = torch.zeros(1, dtype=torch.int32).expand(2**31)
    with refused(ValueError, "cell_sort: cells must have fewer than 2**31 rows, got 2147483648: split the batch"):
        ops.cell_sort(many, 2)
    with refused(ValueError, "nearest_centre: points must have fewer than 2**31 rows, got 2147483648: split the batch"):
        ops.nearest_centre(torch.zeros(1, 3).expand(2**31, 3), torch.zeros(1, 3))


@pytest.mark.parametrize("op", ["march_rays", "render_opaque", "resample"])
def test_more_results_than_an_index_can_number_are_refused(op):
    """Kernels add up the samples of all rays in int32."""
    arguments = CASES[op].make(Draw(), 11)
    arguments.pop("uniforms", None)
    count, name = ("count", "count times the rays") if op == "resample" else ("samples", "samples of all rays")
    for key, value in arguments.items():
        if isinstance(value, torch.Tensor):
            rows = value[:1].expand(2**16 + 1, *value.shape[1:]) if len(value) == 11 else value
            arguments[key] = rows.to("meta")  # nothing is computed
    with refused(ValueError, f"{op}: {name} must have fewer than 2**31 rows, got 2147516416: split the batch"):
        getattr(ops, op)(**{**arguments, count: 2**15})


def test_more_rays_than_any_input_fills_are_refused_before_memory_is_taken():
    offsets = torch.zeros(1, dtype=torch.int32).expand(2**31 - 1)
    with refused(ValueError, "composite: ray_offsets must have at most 134217729 entries, got 2147483647"):
        ops.composite(torch.rand(4), torch.rand(4, 3), torch.rand(4), torch.rand(4), ray_offsets=offsets)
