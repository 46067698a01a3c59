"""Tests of the plans of cell_sort: the kind of sort, and the layout of the workspace."""

import itertools

import pytest
from emulated import module
from helpers import refuses

AUTOMATIC, COUNTING, RADIX = range(3)
MOST = 2**31 - 1
SORTED_ROWS = (0, 1, 2047, 2048, 2049, 4_000_000, MOST)
CELLS = (1, 2, 254, 255, 510, 511, 1022, 1023, 4096, 65_534, 65_535, 1 << 20, MOST - 2)


def test_few_cells_are_counted_and_many_sorted_by_radix():
    for k, n in itertools.product(CELLS, SORTED_ROWS):
        assert module().cell_sort_plan(n, k, AUTOMATIC, 0)["radix"] == (k > 1022)
        assert module().cell_sort_plan(n, k, RADIX, 0)["radix"]
    for k in CELLS[CELLS.index(1022) + 1 :]:
        refuses("too many cells for counting", module().cell_sort_plan, 1, k, COUNTING, 0, error=RuntimeError)


def test_keys_have_exactly_the_bits_of_the_buckets():
    for k in CELLS:
        plan = module().cell_sort_plan(100, k, RADIX, 0)
        assert plan["bits"] == (k + 1).bit_length(), "the largest bucket is k + 1"
        assert plan["key_bytes"] == (2 if plan["bits"] <= 16 else 4)


@pytest.mark.parametrize("k", CELLS)
def test_parts_of_the_workspace_lie_side_by_side(k):
    for way, n, temporary in itertools.product((AUTOMATIC, RADIX), SORTED_ROWS, (0, 12_345)):
        plan = module().cell_sort_plan(n, k, way, temporary)
        if plan["radix"]:
            sizes = [n * plan["key_bytes"], n * plan["key_bytes"], 4 * n, temporary]
        else:
            # Full blocks of eight chunks cover all rows.
            assert plan["chunks"] % 8 == 0 and plan["chunks"] * plan["chunk_rows"] >= n
            assert n > (plan["chunks"] - 8) * plan["chunk_rows"]
            counts = plan["chunks"] * (k + 2)
            assert 4096 * plan["tiles"] >= counts
            sizes = [4 * counts, 4 * plan["tiles"]]
            assert 2 * counts <= n + 16 * max(k + 2, 512), "histograms stay a fraction of the rows"
        ends = [*plan["parts"][1:], plan["bytes"]]
        for start, size, end in zip(plan["parts"], sizes, ends):
            assert start % 256 == 0 and start + size <= end < start + size + 256
        assert plan["bytes"] == ends[-2] + sizes[-1]
