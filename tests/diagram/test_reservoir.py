"""The reservoir of importance samples against a plain sort of every batch."""

import pytest
import torch
from helpers import refuses, same, seeded

from voronerf.diagram import VoronoiDiagram, split_diagram
from voronerf.diagram.reservoir import SampleReservoir


def batch(seed, n):
    generator = seeded(seed)
    return torch.randn(n, 3, generator=generator), torch.rand(n, generator=generator) + 0.1


def rows(points, importance):
    return {tuple(row) for row in torch.cat([points, importance[:, None]], 1).tolist()}


def heaviest(seed, n, count):
    points, importance = batch(seed, n)
    kept = sorted(range(n), key=lambda i: -float(importance[i]))[:count]
    return rows(points[kept], importance[kept])


def test_every_batch_gives_an_equal_share_of_its_heaviest():
    reservoir = SampleReservoir(10, batches=3)
    assert reservoir.quota == 4
    for seed in range(2):
        reservoir.add(*batch(seed, 50))
    assert rows(*reservoir.samples()) == heaviest(0, 50, 4) | heaviest(1, 50, 4)
    assert len(reservoir) == 8


def test_the_oldest_batch_is_overwritten_and_memory_stays_bounded():
    reservoir = SampleReservoir(12, batches=3)
    sizes = set()
    for seed in range(8):
        reservoir.add(*batch(seed, 50))
        sizes.add(sum(table.numel() for table in reservoir.state_dict().values()))
    assert len(sizes) == 1
    assert rows(*reservoir.samples()) == set().union(*(heaviest(seed, 50, 4) for seed in (5, 6, 7)))
    points, _ = reservoir.samples()
    assert rows(points[:4], torch.zeros(4)) == {(*row[:3], 0.0) for row in heaviest(5, 50, 4)}


def test_small_and_empty_batches_give_what_they_have():
    reservoir = SampleReservoir(20, batches=2)
    reservoir.add(*batch(0, 50))
    reservoir.add(*batch(1, 50))
    reservoir.add(*batch(2, 3))
    assert rows(*reservoir.samples()) == heaviest(1, 50, 10) | heaviest(2, 3, 3)
    reservoir.add(torch.empty(0, 3), torch.empty(0))
    assert rows(*reservoir.samples()) == heaviest(2, 3, 3)
    reservoir.add(*batch(3, 1))
    assert rows(*reservoir.samples()) == heaviest(3, 1, 1)


def test_worthless_samples_are_never_kept():
    reservoir = SampleReservoir(6, batches=1)
    points, importance = batch(0, 8)
    importance[:3] = torch.tensor([0.0, float("nan"), float("inf")])
    importance[3] = -1.0
    points[4, 1] = float("nan")
    points[5, 2] = -float("inf")
    reservoir.add(points, importance)
    assert rows(*reservoir.samples()) == rows(points[6:], importance[6:])
    reservoir.add(points[:1], importance[:1])
    points, importance = reservoir.samples()
    assert (points.shape, importance.shape) == ((0, 3), (0,))


def test_leading_shapes_other_types_and_gradients_are_taken():
    points, importance = batch(0, 24)
    reservoir, other = SampleReservoir(8, batches=1), SampleReservoir(8, batches=1)
    reservoir.add(points, importance)
    other.add(points.double().reshape(4, 6, 3).requires_grad_(), importance.reshape(4, 6))
    assert rows(*reservoir.samples()) == rows(*other.samples())
    kept, weights = other.samples()
    assert (kept.dtype, weights.dtype, kept.requires_grad) == (torch.float32, torch.float32, False)


def test_a_state_restores_the_reservoir_bit_for_bit_and_no_other():
    reservoir = SampleReservoir(30, batches=4)
    for seed in range(6):
        reservoir.add(*batch(seed, 40))
    restored = SampleReservoir(30, batches=4)
    restored.load_state_dict(reservoir.state_dict())
    for seed in range(6, 9):
        for which in (reservoir, restored):
            which.add(*batch(seed, 40))
        assert same(reservoir.samples(), restored.samples())

    state = reservoir.state_dict()
    refuses(
        "points must have shape [5, 6, 3] (batches, quota), got [4, 8, 3]",
        SampleReservoir(30, batches=5).load_state_dict,
        state,
    )
    del state["added"]
    refuses("state must hold added, got points, importance", restored.load_state_dict, state)


@pytest.mark.parametrize("d", [1, 2, 4])
def test_samples_of_other_dimensions_decide_a_split(d):
    points, importance = torch.rand(400, d), torch.rand(400)
    points[0], importance[0] = torch.nan, 1.0
    reservoir = SampleReservoir(100, batches=2, d=d)
    for half in (slice(0, 200), slice(200, 400)):
        reservoir.add(points[half], importance[half])
    kept, _ = reservoir.samples()
    assert kept.shape == (99, d) and kept.isfinite().all()  # the heaviest point is NaN
    diagram = VoronoiDiagram(torch.zeros(1, d))
    assert split_diagram(diagram, *reservoir.samples(), 4).diagram.num_cells == 4


def test_bad_input_gets_one_clear_line():
    refuses("at least 1, got 0, 5 and 3", SampleReservoir, 0, batches=5)
    refuses("at least 1, got 5, 0 and 3", SampleReservoir, 5, batches=0)
    refuses("at least 1, got 5, 5 and 0", SampleReservoir, 5, batches=5, d=0)
    add = SampleReservoir(5, batches=5).add
    refuses("got [4, 2] and [4]", add, torch.zeros(4, 2), torch.zeros(4))
    refuses("got [4, 3] and [3]", add, torch.zeros(4, 3), torch.zeros(3))
