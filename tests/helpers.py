"""Helpers for all tests: expected errors, pairwise parameters, seeds, tensor equality, threads, scripts, JSON files."""

import contextlib
import io
import itertools
import json
import runpy
import subprocess
import sys
from collections.abc import Mapping
from unittest import mock

import pytest
import torch

from voronerf.app import train
from voronerf.nerf import Hierarchical, Occupancy, Renderer, Space, Stratified


def refuses(message, call, *args, error=ValueError, **options):
    """Fails unless the call raises a one-line error that contains ``message`` literally."""
    with pytest.raises(error) as caught:
        call(*args, **options)
    text = str(caught.value)
    assert message in text and "\n" not in text, text


def all_pairs(values):
    """Returns arguments for ``parametrize``: few rows, in which every pair of values of two parameters occurs.

    A key may name several parameters, such as "i, o"; its values are tuples.
    """
    columns = [list(column) for column in values.values()]
    numbers = [range(len(column)) for column in columns]

    def pairs(row):
        return set(itertools.combinations(enumerate(row), 2))

    products = {row: pairs(row) for row in itertools.product(*numbers)}
    missing, rows = set().union(*products.values()), []
    while missing:
        row = max(products, key=lambda row: len(products[row] & missing))
        missing -= products.pop(row)
        parts = [(column[i], "," in name) for name, column, i in zip(values, columns, row)]
        rows.append(tuple(part for value, several in parts for part in (value if several else (value,))))
    return ", ".join(values), rows


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def same(first, second):
    """Returns whether two sequences or dictionaries of tensors are equal bit for bit. None equals None."""
    if isinstance(first, Mapping):
        return first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)
    return all(
        a is b or (a is not None and b is not None and torch.equal(a, b)) for a, b in zip(first, second, strict=True)
    )


def on_any_number_of_threads(run, counts=(1, 2, 3)):
    """Returns the tensors of ``run``; fails unless they are equal bit for bit for each number of threads."""
    before, results = torch.get_num_threads(), []
    try:
        for count in counts:
            torch.set_num_threads(count)
            results.append(list(run()))
    finally:
        torch.set_num_threads(before)
    for count, other in zip(counts, results):
        assert same(results[0], other), f"results differ between {count} and {counts[0]} threads"
    return results[0]


def python(*args, timeout=600, **options):
    """Runs Python in a new process, which must succeed within ``timeout`` seconds; returns its output."""
    command = [sys.executable, *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def script(path, *args):
    """Runs a Python script in this process, where torch is already imported; returns its output."""
    said = io.StringIO()
    with (
        contextlib.redirect_stdout(said),
        mock.patch.object(sys, "argv", [str(path), *map(str, args)]),
        mock.patch.object(sys, "path", [str(path.parent), *sys.path]),
    ):
        try:
            runpy.run_path(str(path), run_name="__main__")
        except SystemExit as end:
            assert not end.code, end.code
    return said.getvalue()


def read_json(path):
    return json.loads(path.read_text())


def trained(config, scene, *, stop_at=None, resume=False, on_event=None, callbacks=(), **options):
    """Trains into ``config.out`` like `voronerf train` without a display; returns the summary.

    ``stop_at`` is the step after which the training is stopped; other options go to ``run``.
    """
    state = train.build(config, scene, on_event=on_event)
    if resume:
        train.load(state, train.last_checkpoint(config.out))

    class Stop(train.Callback):
        def after_step(self, state):
            if state.step == stop_at:
                state.stop()

    scores = train.Scores(config.out)
    callbacks = [train.Divergence(config.out), train.Checkpoints(config.out), scores, Stop(), *callbacks]
    train.run(state, callbacks, **options)
    return scores.summary


def render_image(field, cameras, index, *, samples, occupancy=None, **options):
    """Renders an image of a single field."""
    return renderer_of({"field": field}, samples=samples, occupancy=occupancy).image(cameras, index, **options)


def renderer_of(fields, *, samples, fine_samples=0, occupancy=None, picture_samples=None, backend="auto", **space):
    """Returns a renderer; the arguments choose its sampler: Occupancy, Hierarchical or Stratified."""
    options = {"space": Space(**space), "backend": backend}
    if occupancy is not None:
        sampler = Occupancy(occupancy, samples, picture_samples=picture_samples or samples, **options)
    else:
        sampler = Hierarchical(samples, fine_samples, **options) if fine_samples else Stratified(samples, **options)
    return Renderer(fields, sampler, backend=backend)


class Interrupt:
    """A context that raises KeyboardInterrupt at one of the places where Python looks for signals.

    Attributes:
        places: The number of these places so far: the starts of Python functions, and the ends of C functions.

    Args:
        place: The number of the place; None to count them.
    """

    def __init__(self, place=None):
        self.place, self.places = place, 0

    def __enter__(self):
        sys.setprofile(self._look)
        return self

    def __exit__(self, *error):
        sys.setprofile(None)

    def _look(self, frame, event, argument):
        if event in ("call", "c_return"):
            self.places += 1
            if self.places == self.place:
                raise KeyboardInterrupt
