"""Tests of steps with Python hooks between recorded segments: a user's samplers, split rules, ray sources and terms."""

from __future__ import annotations

import re

import pytest
import torch
from step_training import Training, same

from voronerf.nerf import (
    Batch,
    Occupancy,
    OccupancyGrid,
    PlannedSplit,
    RayBatches,
    RayLoss,
    Rays,
    SparseDepth,
    SplitStrategy,
    replayed,
)
from voronerf.nerf.segment import in_python

pytestmark = pytest.mark.native


class Counting(SplitStrategy):
    """A split rule that counts its calls, and then runs its base class."""

    seen = 0

    def step_post_backward(self, output):
        self.seen += 1
        self.last = output.weights.sum()
        super().step_post_backward(output)


class Middle(Occupancy):
    """A sampler that overrides only the hook for samples."""

    asked = 0

    def sample(self, rays, near, far, *, jitter=False, generator=None):
        self.asked += 1
        return super().sample(rays, near, far, jitter=jitter, generator=generator)


class Learning(Occupancy):
    """A sampler that counts the hooks before and after each step."""

    before = after = 0

    def step_pre_backward(self, field, step, generator):
        self.before += 1
        super().step_pre_backward(field, step, generator)

    def step_post_backward(self, output):
        self.after += 1
        super().step_post_backward(output)


class Helper(Occupancy):
    """A sampler that overrides `march`, which its hooks call."""

    marched = 0

    def march(self, *arguments, **more):
        self.marched += 1
        return super().march(*arguments, **more)


class Own:
    """A ray source that does not inherit from this package."""

    device = torch.device("cpu")

    def __init__(self, batches):
        self.batches, self.drawn = batches, 0

    def draw(self, count, generator):
        self.drawn += 1
        origins = torch.randn(count, 3, generator=generator)
        origins = 3 * torch.nn.functional.normalize(origins, dim=-1)
        rays = Rays(origins, torch.nn.functional.normalize(0.2 * torch.randn(count, 3) - origins, dim=-1))
        ends = torch.full((count,), 1.5), torch.full((count,), 4.5)
        return Batch(rays, *ends, origins.sigmoid(), torch.ones(3))


class Anneal:
    """A loss term that computes its gradient, with a factor that grows in each step."""

    def __init__(self):
        self.factor = 0.0

    def add(self, along, batch):
        self.factor += 0.01
        along.loss.add_(self.factor * along.density.mean())
        along.gradient[:, 3] += self.factor / len(along.density)


def clear(seen, batch):
    return 0.1 * (seen.opacity * (1 - seen.opacity)).mean()


def strategy(training, kind):
    return kind({"field": training.router}, [PlannedSplit(at=1000, children=2)], generator=torch.Generator())


def with_strategy(training, kind=Counting):
    training.step.strategy = strategy(training, kind)


def with_fetch(training):
    training.fetched = 0

    def fetch(pixels):
        training.fetched += 1
        assert pixels.dtype == torch.int64

    training.batches.fetch = fetch


HOOKS = {
    "strategy": ({}, with_strategy, lambda t: t.step.strategy.seen, "Counting.step_post_backward"),
    "sample": ({"sampler": Middle}, lambda t: None, lambda t: t.sampler.asked, "Middle.sample"),
    "grid": ({"sampler": Learning}, lambda t: None, lambda t: t.sampler.after, "Learning.step_post_backward"),
    "helper": ({"sampler": Helper}, lambda t: None, lambda t: t.sampler.marched, "Helper.step_post_backward"),
    "pictures on disk": ({}, with_fetch, lambda t: t.fetched, "RayBatches.draw"),
    "term": ({}, lambda t: setattr(t.loss, "terms", (*t.loss.terms, clear)), None, "clear"),
    "two terms": (
        {"photograph": True},
        lambda t: setattr(t.loss, "terms", (clear, *t.loss.terms, clear)),
        None,
        "clear",
    ),
    "annealed term": (
        {},
        lambda t: setattr(t.loss, "terms", (Anneal(), *t.loss.terms)),
        lambda t: round(100 * t.loss.terms[0].factor),
        "Anneal.add",
    ),
}


@pytest.mark.parametrize("name", HOOKS)
def test_same_bits_as_steps_that_run_as_they_are(name):
    """Each hook runs once per step, also if the step outgrows its memory or a tensor has moved."""
    options, change, count, said = HOOKS[name]
    results = []
    for as_it_is in (False, True):
        training = Training(cells=3, **options)
        change(training)
        steps = training.train(6, lambda step: 64 + step, as_it_is=as_it_is)
        training.router.module.colour.weight.data = training.router.module.colour.weight.data.clone()
        training.sampler.grid.occupied[:] = True
        steps += training.train(6, lambda step: 70 - step, as_it_is=as_it_is)
        results.append([*steps, *training.everything()])
        explained = training.step.explain()
        spent = rf"recorded and replayed(?s:.*)\nin Python: {re.escape(said)}, \d+\.\d{{3}} ms a call"
        assert as_it_is or re.search(spent, explained), explained
        assert "another segment" not in explained
        assert count is None or count(training) == 12
        assert as_it_is or training.recorded < 10
    assert same(*results)


@pytest.mark.parametrize("threads", [1, 2])
def test_own_rays_are_taken(threads):
    """The step takes batches of any size from the source."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    results = []
    for as_it_is in (False, True):
        torch.manual_seed(0)
        training = Training(cells=2)
        training.step.batches = Own(training.batches)
        torch.manual_seed(1)
        steps = training.train(9, lambda step: (64, 50, 79)[step % 3], as_it_is=as_it_is)
        assert training.step.batches.drawn == 9
        results.append([*steps, *training.everything()])
        assert as_it_is or "in Python: Own.draw" in training.step.explain()
    torch.set_num_threads(before)
    assert same(*results)


def test_hooks_are_called_in_each_step_of_a_call():
    """The sampler's own hooks run in each of the 40 steps of a call, not once for a group of steps."""
    training = Training(sampler=Learning)
    training.step(64, 40, at=0)
    assert training.sampler.before == training.sampler.after == 40
    with_strategy(training)
    training.step(64, 20, at=40)
    assert training.step.strategy.seen == 20 and training.recorded < 8


def test_what_a_hook_sets_is_followed():
    """Changed numbers of samples, a robust loss and a frozen parameter take effect at the next step."""

    class Changing(Counting):
        def step_post_backward(self, output):
            super().step_post_backward(output)
            if self.seen == 4:
                self.sampler.samples = 16
            if self.seen in (5, 6):
                self.loss.robust = 0.01 * self.seen
            if self.seen == 8:
                self.routers["field"].module.colour.weight.requires_grad_(False)

    results = []
    for as_it_is in (False, True):
        training = Training(cells=2)
        with_strategy(training, Changing)
        training.step.strategy.sampler, training.step.strategy.loss = training.sampler, training.loss
        steps = training.train(16, as_it_is=as_it_is)
        results.append([*steps, *(tensor for tensor in training.everything() if tensor is not None)])
        assert as_it_is or "recorded and replayed" in training.step.explain()
    assert same(*results)


def test_what_moves_in_a_hook_is_followed_at_once():
    """The segment after the hook runs eagerly on the new memory, and is recorded again."""

    def moving(training):
        def term(seen, batch):
            if training.done == 5:
                weight = training.router.module.colour.weight
                weight.data = weight.data.clone()
            training.done += 1
            return clear(seen, batch)

        return term

    results = []
    for as_it_is in (False, True):
        training = Training(cells=2)
        training.loss.terms = (moving(training),)
        steps = training.train(12, as_it_is=as_it_is)
        results.append([*steps, *training.everything()])
        assert training.done == 12 and training.recorded < 8
    assert same(*results)


def test_a_term_that_begins_later():
    """The term reads other results of the rays in later steps than in the recorded step."""
    results = []
    for as_it_is in (False, True):
        training = Training(cells=2)
        training.loss.terms = (lambda seen, batch, t=training: late(t, seen, batch),)
        steps = training.train(18, as_it_is=as_it_is)
        results.append([*steps, *training.everything()])
        assert as_it_is or "recorded and replayed" in training.step.explain()
    assert same(*results)


def late(training, seen, batch):
    training.done += 1
    if training.done < 6:
        return torch.zeros(())
    return seen.weights.square().mean() if training.done < 12 else 0.01 * seen.density.mean()


def test_a_class_that_says_so_is_replayed():
    @replayed
    class Twice(SplitStrategy):
        def step_post_backward(self, output):
            super().step_post_backward(output)
            super().step_post_backward(output)

    results = []
    for as_it_is in (False, True):
        training = Training(cells=2)
        with_strategy(training, Twice)
        steps = training.train(10, as_it_is=as_it_is)
        results.append([*steps, *training.everything(), *training.step.strategy.state_dict().values()])
        assert as_it_is or "Python" not in training.step.explain()
    assert same(*results)


def test_which_hooks_run_in_python():
    training = Training()
    data = type("Data", (Occupancy,), {"skips": True})
    own, helper, other = (kind(training.sampler.grid, 8) for kind in (Learning, Helper, data))
    hooks = "sample", "step_pre_backward", "step_post_backward"
    assert [in_python(own, hook) for hook in hooks] == [False, True, True]
    assert all(in_python(helper, hook) for hook in hooks) and not any(in_python(other, hook) for hook in hooks)
    assert in_python(Own(None), "draw") and not in_python(training.batches, "draw")
    training.batches.draw = lambda count, generator: RayBatches.draw(training.batches, count, generator)
    assert in_python(training.batches, "draw")


class Scheduled(SparseDepth):
    """A term whose factor is a property instead of an attribute."""

    factor = property(lambda self: 0.3, lambda self, value: None)


class Called(RayLoss):
    """A loss that overrides ``__call__``."""

    calls = 0

    def __call__(self, *arguments, **options):
        self.calls += 1
        return super().__call__(*arguments, **options)


def test_no_behaviour_of_a_subclass_is_passed_over():
    """A property, an overridden ``__call__`` and a hook of an unmarked base class run in Python.

    In the method resolution order, the base class follows a class that is marked as replayed.
    """

    @replayed
    class Marked(SplitStrategy):
        pass

    class Mixed(Marked, Counting):
        pass

    training = Training()
    assert in_python(Scheduled(0.1), "add") and not in_python(SparseDepth(0.1), "add")
    assert in_python(strategy(training, Mixed), "step_post_backward")
    training.step.loss = Called(training.loss.renderer)
    training.train(5)
    assert training.step.loss.calls == 5 and "Called may run Python code" in training.step.explain()


@pytest.mark.parametrize(
    "change",
    [
        lambda grid: setattr(grid, "threshold", 30 * grid.threshold),
        lambda grid: grid.load_state_dict({k: v.clone() for k, v in grid.state_dict().items()}),
    ],
)
def test_what_changes_in_the_grid_is_followed(change):
    results = []
    for as_it_is in (False, True):
        training = Training(cells=2)
        training.train(5, as_it_is=as_it_is)
        change(training.sampler.grid)
        results.append([*training.train(5, as_it_is=as_it_is), *training.everything()])
    assert same(*results)


def test_attributes_of_ones_own_record_nothing_anew():
    """Counters and tensors that the library does not read cause no new recording; an attribute that it reads does."""
    training = Training(sampler=Learning)
    with_strategy(training)
    training.train(4)
    recorded = training.recorded
    training.train(20)
    assert training.recorded == recorded
    training.sampler.grid = OccupancyGrid.for_training(training.sampler.grid.box, 32, resolution=8)
    training.train(4)
    assert training.recorded > recorded
