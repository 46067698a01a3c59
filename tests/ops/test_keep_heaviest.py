"""The heaviest samples of a batch, against a sort in Python."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import on_any_number_of_threads, same
from op_cases import need, refusals, strided

from voronerf.ops import keep_heaviest

pytestmark = pytest.mark.op("keep_heaviest")


def slow(points, importance, q):
    """Returns the importance and the points of the samples that are kept from a batch."""
    ranked = [(-value, i) for i, value in enumerate(importance.tolist()) if 0 < value < math.inf]
    kept, places = torch.zeros(q), torch.zeros(q, points.shape[1])
    for place, (_, i) in enumerate(sorted(ranked)[:q]):
        if bool(points[i].isfinite().all()):
            kept[place], places[place] = importance[i], points[i]
    return kept, places


@pytest.mark.parametrize("order", ["random", "equal", "rising", "falling"])
@pytest.mark.parametrize(("m", "q", "d"), [(0, 3, 3), (1, 1, 1), (9, 20, 3), (1000, 7, 2), (1003, 130, 3)])
def test_equals_sorting(device, backend, m, q, d, order):
    need("keep_heaviest", backend, device, torch.float32)
    points, weights, error = torch.randn(m, d), torch.rand(m), torch.rand(5)
    ray_index = torch.randint(5, (m,), dtype=torch.int32)
    weights[3::11], weights[4::13], weights[5::17], weights[6::50] = 0.0, torch.nan, torch.inf, -0.0
    weights[7::60] *= -1
    points[8::23, 0], points[9::29, d - 1] = torch.nan, -torch.inf
    if order == "equal":
        weights, error = (8 * weights).round() / 8, (2 * error).round() / 2
    rays = {"error": error, "ray_index": ray_index}
    if order in ("rising", "falling"):
        weights, rays = weights.sort(descending=order == "falling").values, {}
    importance = weights if not rays else weights * error[ray_index]
    kept, slots, added = torch.rand(3, q, d), torch.rand(3, q), torch.tensor([5])
    expected = kept.clone(), slots.clone()
    expected[1][2], expected[0][2] = slow(points, importance, q)
    memory = [tensor.to(device, copy=True) for tensor in (kept, slots, added)]
    samples = (strided(tensor.to(device)) for tensor in (points, weights))
    keep_heaviest(*memory, *samples, **{n: strided(tensor.to(device)) for n, tensor in rays.items()}, backend=backend)
    assert same([tensor.cpu() for tensor in memory], (*expected, torch.tensor([6])))


def test_threads_make_no_difference():
    need("keep_heaviest", "native", torch.device("cpu"), torch.float32)
    points, weights = torch.randn(5000, 3), (64 * torch.rand(5000)).round()

    def call():
        memory = torch.zeros(2, 50, 3), torch.zeros(2, 50), torch.zeros(1, dtype=torch.int64)
        keep_heaviest(*memory, points, weights, backend="native")
        return memory

    on_any_number_of_threads(call)


def test_refuses_what_makes_no_sense(backend):
    need("keep_heaviest", backend, torch.device("cpu"), torch.float32)
    kept = {"kept_points": torch.zeros(2, 3, 3), "kept_importance": torch.zeros(2, 3), "added": torch.tensor([0])}
    rays = {"error": torch.rand(2), "ray_index": torch.tensor([0, 1, 1, 0, 0], dtype=torch.int32)}
    samples = {"points": torch.rand(5, 3), "weights": torch.rand(5)}
    refuses = refusals(keep_heaviest, **kept, **samples, **rays, backend=backend)
    refuses("ray_index must lie in 0 to 0, got values from 0 to 1", error=torch.rand(1))
    refuses("ray_index must lie in 0 to -1, got values from 0 to 1", error=torch.rand(0))
    refuses("ray_index must lie in 0 to 1, got values from -1 to 0", ray_index=-rays["ray_index"])
    refuses("error and ray_index must be given together, got no ray_index", ray_index=None)
    refuses("kept_points must be contiguous, got strides (3, 6, 1)", kept_points=torch.zeros(3, 2, 3).transpose(0, 1))
    refuses("added must have shape [1], got [2]", added=torch.zeros(2, dtype=torch.int64))
    assert int(kept["added"]) == 1 and not kept["kept_importance"][1].any()  # only the valid call has added a batch


def test_a_count_may_be_anything(backend):
    need("keep_heaviest", backend, torch.device("cpu"), torch.float32)
    for count, slot in ((-1, 2), (-(2**62), -(2**62) % 3), (2**62, 2**62 % 3)):
        kept, slots, added = torch.zeros(3, 1, 1), torch.zeros(3, 1), torch.tensor([count])
        keep_heaviest(kept, slots, added, torch.ones(1, 1), torch.ones(1), backend=backend)
        assert slots[:, 0].tolist() == [float(place == slot) for place in range(3)] and int(added) == count + 1
