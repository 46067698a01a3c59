"""Tensors that every operation refuses; the case of each op lists the refusals of this op."""

from __future__ import annotations

import pytest
import torch
from cases import CASES, Draw
from helpers import refuses
from torch.utils._pytree import tree_leaves, tree_map

from voronerf import ops
from voronerf.ops._core import backends

POINTS = torch.rand(4, 3)


def composite(**arguments):
    return ops.composite(torch.rand(2, 3), torch.rand(2, 3, 3), torch.rand(2, 3), torch.rand(2, 3), **arguments)


@pytest.mark.parametrize(
    ("kind", "make"),
    [
        ("sparse_coo", lambda: POINTS.to_sparse()),
        ("sparse_csr", lambda: POINTS.to_sparse_csr()),
        ("_mkldnn", lambda: POINTS.to_mkldnn()),
        ("nested", lambda: torch.nested.nested_tensor([POINTS, POINTS])),
        ("quantized", lambda: torch.quantize_per_tensor(POINTS, 0.1, 0, torch.qint8)),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_tensors_that_are_not_dense(kind, make):
    message = f"nearest_centre: points must be a dense tensor, got a {kind} one"
    refuses(message, ops.nearest_centre, make(), POINTS, error=TypeError)


@pytest.mark.op("grouped_linear")
def test_inference_tensors(backend):
    """Ops take inference tensors unless autograd would have to keep them."""
    with torch.inference_mode():
        weight, background = torch.rand(1, 2, 3), torch.ones(3)
        offsets = torch.tensor([0, 4], dtype=torch.int32)
        inside = composite(background=background, backend=backend)
    assert inside.colour.isfinite().all() and composite(background=background).colour.isfinite().all()
    points = POINTS.clone().requires_grad_()
    message = "grouped_linear: offsets must not be an inference tensor while gradients are recorded: clone it"
    refuses(message, ops.grouped_linear, points, offsets, weight.clone(), backend=backend, error=TypeError)
    with torch.no_grad():
        ops.grouped_linear(points, offsets, weight, backend=backend)


@pytest.mark.parametrize("inside", [True, False])
def test_an_op_that_differentiates_inside_takes_inference_tensors(inside):
    with torch.inference_mode():
        call = CASES["render_loss"].make(Draw(3), 7)
        call = tree_map(lambda value: value.clone() if isinstance(value, torch.Tensor) else value, call)
    with torch.inference_mode(inside):
        results = [tree_leaves(ops.render_loss(**call, backend=backend)) for backend in ("reference", "native")]
    for part, other in zip(*results, strict=True):
        assert torch.allclose(part, other, atol=1e-5)


def short_tuples(value):
    """Yields (description of the error, changed value) for named tuples in a value with fewer entries than fields."""
    if hasattr(value, "_fields"):
        kind = type(value)
        for count in range(len(value)):
            rule = f"must have the {len(value)} entries of (a )?{kind.__name__}, got {count}$"
            yield rule, tuple.__new__(kind, value[:count])
    elif isinstance(value, list):
        for index, entry in enumerate(value):
            for rule, short in short_tuples(entry):
                yield rf"\[{index}\] {rule}", [*value[:index], short, *value[index + 1 :]]


@pytest.mark.parametrize(
    ("op", "name"), [("adam", "rules"), ("adam", "guard"), ("draw_pixels", "known_pixels"), ("draw_pixels", "runs")]
)
def test_named_tuples_with_fewer_entries_than_fields(op, name):
    """``tuple.__new__`` makes such tuples; reading the missing entries in C++ would crash."""
    calls = (CASES[op].make(Draw(seed, free=True), 5) for seed in range(99))
    call = next(call for call in calls if call.get(name))
    rules = [*short_tuples(call[name])]
    assert len(rules) > 2
    for backend in (*backends.implemented(op), "auto"):
        for rule, short in rules:
            with pytest.raises(ValueError, match=rf"^{op}: {name} ?{rule}"):
                getattr(ops, op)(**{**call, name: short}, backend=backend)
