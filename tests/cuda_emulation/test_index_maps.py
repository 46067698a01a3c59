"""Tests that the CUDA kernels' index maps (csrc/common/index_maps.h) cover every element once, in range."""

import bisect
import itertools

from emulated import module


def test_a_lanes_sums_are_those_of_the_tile():
    """Checks that lanes cover a tile [16][8] of mma.sync, in pairs of neighbours that kernels write at once."""
    place = module().accumulator_place
    found = [place(lane, i) for lane in range(32) for i in range(4)]
    assert sorted(found) == list(itertools.product(range(16), range(8)))
    for lane in range(32):
        for i in (0, 2):
            row, column = place(lane, i)
            assert place(lane, i + 1) == (row, column + 1) and column % 2 == 0


def test_an_encoding_has_each_column_at_one_place_and_its_waves_in_pairs():
    place, column = module().wave_place, module().wave_column
    for order in itertools.product(range(17), range(1, 8), (0, 1)):
        octaves, features, raw = order
        places = [place(*order, i) for i in range((2 * octaves + raw) * features)]
        assert sorted(places) == list(range(len(places)))
        assert [column(*order, at) for at in places] == list(range(len(places)))
        for octave, feature in itertools.product(range(octaves), range(features)):
            sine = (raw + 2 * octave) * features + feature
            assert places[sine] % 2 == 0 and places[sine + features] == places[sine] + 1
            for count in (4, 2):  # stored at once by a thread
                if octave % count == 0 and octave + count <= octaves:
                    assert places[sine] % (2 * count) == 0
                    assert [places[sine + 2 * i * features] - places[sine] for i in range(count)] == [
                        *range(0, 2 * count, 2)
                    ]


def test_a_tile_is_of_the_cell_that_counts_it():
    """Finds the cell of each tile: for all sets of up to four cells with up to three tiles each, and for many cells."""
    for cells in range(1, 5):
        for tiles in itertools.product(range(4), repeat=cells):
            first = [0, *itertools.accumulate(tiles)]
            owners = [cell for cell, count in enumerate(tiles) for _ in range(count)]
            found = [module().last_not_above(first, cells, tile) for tile in range(first[-1])]
            assert found == owners
    for cells in (31, 32, 33, 70, 1024, 1025, 2100):  # one or several rounds of probes
        tiles = [cell * 7 % 3 for cell in range(cells)]
        first = [0, *itertools.accumulate(tiles)]
        owners = [cell for cell, count in enumerate(tiles) for _ in range(count)]
        assert [module().last_not_above(first, cells, tile) for tile in range(first[-1])] == owners


def test_the_first_row_of_a_cell():
    for n in range(6):
        for keys in itertools.combinations_with_replacement(range(5), n):
            for value in range(-1, 6):
                assert module().first_above(list(keys), value) == bisect.bisect_right(keys, value)


def test_buckets_keep_cells_that_are_none_apart():
    low, high = -(2**31), 2**31 - 1
    for k in (1, 2, 5, 1022, 65_535, high - 1, high):
        for cell in {low, -2, -1, 0, 1, k // 2, k - 1, min(k, high), min(k + 1, high), high}:
            expected = 0 if cell < 0 else k + 1 if cell >= k else cell + 1
            assert module().bucket_of_cell(cell, k) == expected
