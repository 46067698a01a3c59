"""Tensors of kinds that no operation takes; what each op refuses is in its case."""

from __future__ import annotations

import pytest
import torch
from helpers import refuses

from voronerf import ops

POINTS = torch.rand(4, 3)


def composite(**given):
    return ops.composite(torch.rand(2, 3), torch.rand(2, 3, 3), torch.rand(2, 3), torch.rand(2, 3), **given)


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
    """They are taken unless autograd would have to keep them."""
    with torch.inference_mode():
        weight, background = torch.rand(1, 2, 3), torch.ones(3)
        offsets = torch.tensor([0, 4], dtype=torch.int32)
        inside = composite(background=background, backend=backend)
    assert inside.colour.isfinite().all() and composite(background=background).colour.isfinite().all()
    points = POINTS.clone().requires_grad_()
    message = "grouped_linear: offsets must be a copy where gradients are recorded, got an inference tensor"
    refuses(message, ops.grouped_linear, points, offsets, weight.clone(), backend=backend, error=TypeError)
    with torch.no_grad():
        ops.grouped_linear(points, offsets, weight, backend=backend)
