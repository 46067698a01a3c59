"""Calls every op with row counts just below and just above multiples of each kernel's block size."""

import blocks
import op_attacks
import pytest
import torch

from voronerf.ops._core.cases import Draw

COMPARED = [op for op, case in op_attacks.CASES.items() if case.comparable]


def test_constants_of_kernels_are_found():
    assert {16, 32, 64, 128, 256, 1024, 2048, 4096, 16384, 32768} <= set(blocks.blocks())
    assert {127, 128, 129, 385, 4097, 16383} <= set(blocks.sizes(20_000)) and max(blocks.sizes(20_000)) <= 20_000


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
