"""The index maps of the CUDA kernels (csrc/common/index_maps.h), all of them: every element once, none out of range."""

import bisect
import itertools

import pytest
from emulated import module

THREADS, ROWS, COLUMNS = 128, 64, 128
"""Of a block of the products, and its tile."""


def test_a_lanes_sums_are_those_of_the_tile():
    """A tile [16][8] of mma.sync, and pairs of neighbours, which the kernels write at once."""
    place = module().accumulator_place
    found = [place(lane, i) for lane in range(32) for i in range(4)]
    assert sorted(found) == list(itertools.product(range(16), range(8)))
    for lane in range(32):
        for i in (0, 2):
            row, column = place(lane, i)
            assert place(lane, i + 1) == (row, column + 1) and column % 2 == 0


def test_the_sums_of_a_block_are_its_tile():
    place = module().product_place
    found = [place(*at) for at in itertools.product(range(THREADS), range(2), range(8), range(4))]
    assert sorted(found) == list(itertools.product(range(ROWS), range(COLUMNS)))


@pytest.mark.parametrize("columns", range(8, COLUMNS + 64, 8))
def test_a_block_with_fewer_columns_has_just_those(columns):
    emulated = module()
    found = set()
    for thread in range(THREADS):
        tiles = emulated.product_warp_tiles(thread, columns)
        found |= {emulated.product_place(thread, 0, t, 0)[1] // 8 for t in range(tiles)}
        assert 0 <= tiles <= 8
    assert found == set(range(min(columns, COLUMNS) // 8))


@pytest.mark.parametrize(
    ("rows", "words"),
    # By rows: chunks of 64 bytes; by depth: 32 or 16 rows of 64 or 128 elements of 2 or 4 bytes.
    [(64, 4), (128, 4), (32, 8), (32, 16), (16, 16), (16, 32)],
)
def test_threads_copy_every_word_of_a_tile(rows, words):
    turns = rows * words // THREADS
    found = [module().fetched_word(t, i, THREADS, words) for t in range(THREADS) for i in range(turns)]
    assert sorted(found) == list(itertools.product(range(rows), range(words)))


@pytest.mark.parametrize("inputs", [16, 112, 128, 144, 256, 272])
@pytest.mark.parametrize("outputs", [16, 48, 64, 80, 128, 336])
def test_blocks_cover_the_weight_gradients_of_all_cells(outputs, inputs):
    emulated, cells = module(), 3
    tiles = emulated.gradient_tiles(outputs, inputs, ROWS, COLUMNS)
    found = [emulated.gradient_tile(block, outputs, inputs, ROWS, COLUMNS) for block in range(tiles * cells)]
    expected = itertools.product(range(cells), range(0, outputs, ROWS), range(0, inputs, COLUMNS))
    assert sorted(found) == list(expected)


@pytest.mark.parametrize("step", [16, 32])
@pytest.mark.parametrize("parts", [1, 2, 3, 7, 64])
def test_parts_of_a_cells_rows_are_all_of_them(parts, step):
    for begin, rows in itertools.product((0, 5, 1000), (0, 1, 15, 16, 17, 33, 100, 448, 449, 4097)):
        found = []
        for part in range(parts):
            first, last = module().part_of_rows(begin, begin + rows, part, parts, step)
            if first < last:
                assert last == begin + rows or (last - first) % step == 0
                found += range(first, last)
        assert found == list(range(begin, begin + rows))


def test_a_tile_is_of_the_cell_that_counts_it():
    """Every way in which up to four cells have up to three tiles each."""
    for cells in range(1, 5):
        for tiles in itertools.product(range(4), repeat=cells):
            first = [0, *itertools.accumulate(tiles)]
            owners = [cell for cell, count in enumerate(tiles) for _ in range(count)]
            found = [module().last_not_above(first, cells, tile) for tile in range(first[-1])]
            assert found == owners


def test_the_first_row_of_a_cell():
    for n in range(6):
        for keys in itertools.combinations_with_replacement(range(5), n):
            for value in range(-1, 6):
                assert module().first_above(list(keys), value) == bisect.bisect_right(keys, value)


def test_columns_of_sources_and_packed_ones_are_each_others_inverse():
    emulated = module()
    for widths in itertools.chain.from_iterable(
        itertools.product((1, 3, 15, 16, 17, 63), repeat=count) for count in (1, 2, 3)
    ):
        padded = [-(-width // 16) * 16 for width in widths]
        expected = []
        column = 0
        for width, whole in zip(widths, padded):
            expected += [*range(column, column + width), *[-1] * (whole - width)]
            column += width
        found = [emulated.column_of_packed(widths, padded, packed) for packed in range(sum(padded))]
        assert found == expected
        assert emulated.column_of_packed(widths, padded, sum(padded)) == -1
        assert [expected.index(c) for c in range(column)] == [
            emulated.packed_of_column(widths, padded, c) for c in range(column)
        ]


def test_buckets_keep_cells_that_are_none_apart():
    low, high = -(2**31), 2**31 - 1
    for k in (1, 2, 5, 1022, 65_535, high - 1, high):
        for cell in {low, -2, -1, 0, 1, k // 2, k - 1, min(k, high), min(k + 1, high), high}:
            expected = 0 if cell < 0 else k + 1 if cell >= k else cell + 1
            assert module().bucket_of_cell(cell, k) == expected
