from __future__ import annotations

import pytest
import torch
from cases import CASES, Draw
from op_cases import refused

from voronerf import ops
from voronerf.ops._core import checks


def test_shape_binds_letters():
    sizes = {}
    checks.check_shape("op", "a", torch.zeros(4, 3), ("n", 3), sizes)
    checks.check_shape("op", "b", torch.zeros(5), ("n+1",), sizes)
    checks.check_shape("op", "c", torch.zeros(0), ("m",), sizes)
    assert sizes == {"n": 4, "m": 0}


@pytest.mark.parametrize(
    ("shape", "rule", "message"),
    [
        ((8, 2), ("k", 3), r"op: x must have shape \[k, 3\], got \[8, 2\]"),
        ((8,), ("k", 3), r"op: x must have shape \[k, 3\], got \[8\]"),
        ((3, 3), ("n", 3), r"op: x must have shape \[n, 3\] with n = 4, got \[3, 3\]"),
        ((4,), ("n+1",), r"op: x must have shape \[n\+1\] with n = 4, got \[4\]"),
        ((0,), ("k+1",), r"op: x must have shape \[k\+1\], got \[0\]"),
    ],
)
def test_shape_errors(shape, rule, message):
    with pytest.raises(ValueError, match=f"^{message}$"):
        checks.check_shape("op", "x", torch.zeros(shape), rule, {"n": 4})


def test_tensor_and_dtype_errors():
    with refused(TypeError, "op: x must be a tensor, got list"):
        checks.check_shape("op", "x", [1.0], ("n",))
    with refused(TypeError, "op: x must have dtype float16, bfloat16, float32 or float64, got int64"):
        checks.check_dtype("op", "x", torch.zeros(1, dtype=torch.int64))
    with refused(TypeError, "op: i must have dtype int32, got int64"):
        checks.check_dtype("op", "i", torch.zeros(1, dtype=torch.int64), checks.INDEX)
    with refused(TypeError, "op: b must have the dtype of a, float32, got float64"):
        checks.check_same_dtype("op", n=None, a=torch.zeros(1), m=None, b=torch.zeros(1, dtype=torch.float64))


def test_device_errors():
    checks.check_same_device("op", a=torch.zeros(1), b=None, c=torch.zeros(2))
    with refused(ValueError, "op: c must be on the device of a, cpu, got meta"):
        checks.check_same_device("op", a=torch.zeros(1), b=None, c=torch.zeros(2, device="meta"))


def test_counts_and_integers():
    checks.check_count("op", "x", 2**31 - 1)
    with refused(ValueError, "op: x must have fewer than 2**31 rows, got 2147483648: split the batch"):
        checks.check_count("op", "x", 2**31)
    with refused(ValueError, "op: k must be at least 1, got 0"):
        checks.check_integer("op", "k", 0, 1)
    for value in (1.0, True, "1"):
        with refused(TypeError, "op: k must be an integer, got ..."):
            checks.check_integer("op", "k", value, 1)
    with refused(ValueError, "op: a must be one of x, y, got 'z'"):
        checks.check_choice("op", "a", "z", ("x", "y"))


def test_a_batch_too_large_for_its_index_is_refused_before_it_is_touched():
    from voronerf.ops import cell_sort, nearest_centre

    many = torch.zeros(1, dtype=torch.int32).expand(2**31)
    with refused(ValueError, "cell_sort: cells must have fewer than 2**31 rows, got 2147483648: split the batch"):
        cell_sort(many, 2)
    with refused(ValueError, "nearest_centre: points must have fewer than 2**31 rows, got 2147483648: split the batch"):
        nearest_centre(torch.zeros(1, 3).expand(2**31, 3), torch.zeros(1, 3))


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


def test_more_cells_than_any_input_fills_are_refused_before_memory_is_taken():
    from voronerf.ops import cell_sort, composite

    with refused(ValueError, "cell_sort: k must be at most 134217728, got 2147483647"):
        cell_sort(torch.zeros(3, dtype=torch.int32), 2**31 - 1)
    offsets = torch.zeros(1, dtype=torch.int32).expand(2**31 - 1)
    with refused(ValueError, "composite: ray_offsets must have at most 134217729 entries, got 2147483647"):
        composite(torch.rand(4), torch.rand(4, 3), torch.rand(4), torch.rand(4), ray_offsets=offsets)
