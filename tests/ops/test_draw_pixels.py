"""Tests that the pixels of a batch are drawn from runs, ranges of consecutive pixels."""

import functools

import pytest
import torch
from helpers import on_any_number_of_threads, refuses, same

from voronerf.ops import draw_pixels as draw
from voronerf.ops.draw_pixels.reference import KnownPixels, PixelRuns, draw_pixels

SEED = torch.tensor([-7], dtype=torch.int32)
# The first pixels and the lengths of runs: one pixel, many runs of equal length, and runs of very different lengths.
RUNS = {
    "one": ([5], [1]),
    "even": (range(0, 3000, 10), [7] * 300),
    "uneven": ([2, 10, 50, 70, 5000, 2**40], [1, 1, 3, 500, 1, 1]),
}


def runs_of(start, length):
    return PixelRuns.of(torch.tensor(start), torch.tensor(length))


@pytest.mark.parametrize("name", RUNS)
def test_every_pixel_of_the_runs_is_drawn_as_often(name):
    runs = runs_of(*map(list, RUNS[name]))
    there = torch.cat([torch.arange(first, first + count) for first, count in zip(*RUNS[name])])
    pixels, uniforms, _ = draw_pixels(SEED, 100 * len(there), len(there), runs, None)
    drawn, counts = pixels.unique(return_counts=True)
    assert torch.equal(drawn, there) and bool(((counts - 100).abs() < 50).all())  # within five standard deviations
    assert uniforms.shape == (100 * len(there), 3) and bool(((uniforms >= 0) & (uniforms < 1)).all())


@pytest.mark.native
@pytest.mark.parametrize("name", [None, *RUNS])
@pytest.mark.parametrize("count", [0, 1, 257, 5000])
def test_native_draws_are_those_of_the_reference(name, count):
    from voronerf.ops.draw_pixels.native import draw_pixels as drawn

    runs = None if name is None else runs_of(*map(list, RUNS[name]))
    below = 10**9 if runs is None else runs.total
    for several in (None, 0, count // 3, count):
        known = None if several is None else KnownPixels(torch.arange(70, 80), torch.rand(10), several)
        arguments = SEED, count, below, runs, known
        assert same(on_any_number_of_threads(functools.partial(drawn, *arguments)), draw_pixels(*arguments))


@pytest.mark.parametrize("backend", ["reference", "native"])
def test_consecutive_seeds_draw_different_pixels(backend):
    drawn = [draw(torch.tensor([seed], dtype=torch.int32), 500, 10**9, backend=backend)[0] for seed in (7, 8)]
    assert len(torch.cat(drawn).unique()) > 990


@pytest.mark.parametrize("backend", ["reference", "native"])
def test_tables_of_runs_that_do_not_fit_each_other_stay_in_bounds(backend):
    runs = runs_of([2, 10, 50], [7, 100, 3])
    for change in (
        {"ends": runs.ends * 0},
        {"ends": runs.ends + 2**40},
        {"first": torch.tensor([2**31 - 1, -(2**31)], dtype=torch.int32)},
        {"first": runs.first[:1], "bits": 0},
        {"bits": 48},
    ):
        pixels, *_ = draw(SEED, 1000, 110, runs=runs._replace(**change), backend=backend)
        assert set((pixels - draw(SEED, 1000, 110, backend=backend)[0]).tolist()) <= set(runs.shift.tolist())


@pytest.mark.parametrize("backend", ["reference", "native"])
def test_known_pixels_come_first_with_their_distances(backend):
    known = KnownPixels(torch.tensor([1000, 3000, 2000]), torch.tensor([1.0, 3.0, 2.0]), 300)
    pixels, uniforms, distances = draw(SEED, 1000, 50, known_pixels=known, backend=backend)
    assert torch.equal(pixels[:300].float(), 1000 * distances) and len(distances) == 300
    assert bool(((distances.unique(return_counts=True)[1] - 100).abs() < 45).all())  # five standard deviations
    others = draw(SEED, 1000, 50, backend=backend)
    assert torch.equal(pixels[300:], others[0][300:]) and torch.equal(uniforms, others[1]) and not len(others[2])


EMPTY = {"pixels": torch.zeros(0, dtype=torch.int64), "distances": torch.zeros(0)}


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("known_pixels", {"pixels": torch.zeros(2).long()}, "distances must have shape [p] with p = 2, got [3]"),
        ("known_pixels", EMPTY, "known_pixels must hold at least one"),
        ("known_pixels", {"draws": 4}, "draws must be at most 3, got 4"),
        ("runs", {"shift": torch.zeros(2).long()}, "shift must have shape [n] with n = 1, got [2]"),
        ("runs", {"first": torch.zeros(0).int()}, "runs must hold at least one run, got none"),
        ("runs", {"bits": 64}, "bits must be at most 48, got 64"),
        ("runs", {"total": 9}, "below must be the 9 pixels of the runs, got 5"),
    ],
)
def test_forged_tables_are_refused(name, change, message):
    tables = {"known_pixels": KnownPixels(torch.tensor([1, 2, 3]), torch.rand(3), 2), "runs": runs_of([2], [5])}
    refuses(f"draw_pixels: {message}", draw, SEED, 3, 5, **{name: tables[name]._replace(**change)})


def test_runs_that_do_not_fit_each_other_are_refused_where_they_are_made():
    runs = runs_of([2, 10, 50], [7, 100, 3])
    assert PixelRuns(*runs) == runs
    rising = "PixelRuns: ends must ascend from at least 1 to the total, 110, got "
    for ends in ([100, 7, 110], [7, 7, 110], [0, 107, 110], [7, 107, 111]):
        refuses(f"{rising}{ends}", PixelRuns, torch.tensor(ends), *runs[1:])
    rising = "PixelRuns: ends must ascend from at least 1 to the total, 9, got "
    refuses(f"{rising}[7, 7, 9]", runs_of, [2, 10, 50], [7, 0, 2])
    places = f"PixelRuns: first must hold the run of every {1 << runs.bits}th of the 110 pixels, got "
    for first in (runs.first + 3, runs.first[:1], runs.first.flip(0)):
        refuses(f"{places}{first.tolist()}", PixelRuns, runs.ends, runs.shift, first, runs.bits, runs.total)
