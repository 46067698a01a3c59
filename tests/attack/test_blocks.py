"""Calls every op with row counts just below and just above multiples of each kernel's block size."""

import blocks
import op_attacks
import pytest
import torch
from cases import Draw
from pages import at_page_end

COMPARED = [op for op, case in op_attacks.CASES.items() if case.comparable]


def test_constants_of_kernels_are_found():
    assert {16, 32, 64, 128, 256, 1024, 2048, 4096, 16384, 32768} <= set(blocks.blocks())
    assert {127, 128, 129, 385, 4097, 16383} <= set(blocks.sizes(20_000)) and max(blocks.sizes(20_000)) <= 20_000


@pytest.fixture
def at_page_ends(monkeypatch):
    """Places results at the ends of pages, as `op_attacks.results` places arguments and incoming gradients.

    Runs with three threads.
    """
    for place, name in ((torch.Tensor, "new_empty"), (torch, "empty")):
        make = getattr(place, name)
        monkeypatch.setattr(place, name, lambda *args, make=make, **options: at_page_end(make(*args, **options)))
    before = torch.get_num_threads()
    torch.set_num_threads(3)
    yield
    torch.set_num_threads(before)


@pytest.mark.native
@pytest.mark.parametrize("op", op_attacks.CASES)
def test_touches_nothing_behind_a_tensor(at_page_ends, op):
    """An access behind a tensor ends the process."""
    case = op_attacks.CASES[op]
    for n in (1, 7, 16, 17, 32, 33, 48, 128):
        for draw in (Draw(n, **[*case.kinds.values()][n % len(case.kinds)]), Draw(n, free=True)):
            op_attacks.results(op, case.make(draw, n), "auto", case.differentiable)


@pytest.mark.native
@pytest.mark.parametrize("k", [17, 33, 300])
def test_nearest_centre_stays_in_its_index_with_an_infinite_bound(at_page_ends, k):
    """The distance of 3e38 to the last point's centre overflows; the boxes of missing children are infinitely far."""
    call = op_attacks.CASES["nearest_centre"].make(Draw(k=k, indexed=True), 16)
    call["points"][1::2] = 3e38
    op_attacks.results("nearest_centre", call, "native", gradients=False)


@pytest.mark.native
def test_keep_heaviest_has_memory_for_ascending_samples(at_page_ends):
    """Every sample is heavier than all samples before it, so that it is collected."""
    call = op_attacks.CASES["keep_heaviest"].make(Draw(rays=False), 128)
    op_attacks.results("keep_heaviest", {**call, "weights": torch.arange(128.0)}, "native", gradients=False)


@pytest.mark.slow
@pytest.mark.native
@pytest.mark.parametrize("op", op_attacks.CASES)
def test_touches_nothing_behind_a_tensor_with_any_instruction_set(at_page_ends, isa, op):
    case = op_attacks.CASES[op]
    for n in blocks.sizes(260):
        for draw in (*(Draw(n, **kind) for kind in case.kinds.values()), Draw(n, free=True)):
            op_attacks.results(op, case.make(draw, n), "auto", case.differentiable)


@pytest.mark.slow
@pytest.mark.native
@pytest.mark.parametrize("op", COMPARED)
def test_over_the_blocks_of_kernels(op):
    """Compares with the reference on one and three threads; rays and cells are few, so they extend over many blocks."""
    case, most, before = op_attacks.CASES[op], 5_000 if op in op_attacks.SLOW else 200_000, torch.get_num_threads()
    try:
        for n in blocks.sizes(most):
            torch.set_num_threads(1 + 2 * (n % 2))
            for draw in (Draw(n), Draw(n, free=True)) if n < 10_000 else (Draw(n),):
                call = case.make(draw, n)
                op_attacks.compare(op, call, call, gradients=case.differentiable and n < 10_000)
    finally:
        torch.set_num_threads(before)
