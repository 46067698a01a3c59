"""Tests of steps with Python hooks between recorded segments: a user's samplers, split rules, ray sources and terms."""

from __future__ import annotations

import copy
import pickle
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
from voronerf.nerf.replay import Replay, Stage, in_python
from voronerf.ops import nearest_centre

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
        along.slopes.density.add_(self.factor / len(along.density))


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
    "rays": ({}, lambda t: setattr(t.step, "batches", Own(t.batches)), lambda t: t.step.batches.drawn, "Own.draw"),
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


def test_hooks_are_called_in_each_step_of_a_call():
    """The sampler's own hooks run in each of the 40 steps of a call, not once for a group of steps."""
    training = Training(sampler=Learning)
    training.step(64, 40, at=0)
    assert training.sampler.before == training.sampler.after == 40
    with_strategy(training)
    training.step(64, 20, at=40)
    assert training.step.strategy.seen == 20 and training.recorded < 8


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


def test_a_segment_whose_argument_has_other_names_is_recorded_again():
    """A hook may return its results under other names than in the recorded step."""
    names, centres = iter(("near", "near", "far", "far")), torch.tensor([[0.0, 0, 0], [1, 1, 1]])

    def find(given):
        runs.append(1)
        return {"cells": nearest_centre(given["near"] if "near" in given else 1 - given["far"], centres)}

    hook = Stage("hook", lambda: {"given": {next(names): torch.ones(2, 3)}}, python=True)
    replay, runs, cells = Replay(lambda: [hook, Stage("find", find, ("given",))]), [], []
    for _ in range(4):
        results = replay({})
        cells.append((len(runs), results.now(results.value["cells"]).tolist()))
    assert cells == [(1, [1, 1]), (1, [1, 1]), (2, [0, 0]), (2, [0, 0])]


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


@replayed
class Optional(SparseDepth):
    """A `replayed` term whose attributes have names from outside."""

    def __init__(self, **options):
        super().__init__(0.0)
        self.nested = dict(options)
        for name, value in options.items():
            setattr(self, name, value)

    def add(self, along, batch):
        along.slopes.density.add_(1e-3 * getattr(self, next(iter(self.nested))) * self.nested["gain"])


@pytest.mark.parametrize("change", [lambda term: setattr(term, "gain", 2.0), lambda term: term.nested.update(gain=3.0)])
def test_each_attribute_of_a_replayed_class_is_followed(change):
    results = []
    for as_it_is in (False, True):
        training = Training(cells=2)
        training.loss.terms = (Optional(gain=0.5),)
        training.train(4, as_it_is=as_it_is)
        change(training.loss.terms[0])
        results.append([*training.train(4, as_it_is=as_it_is), *training.everything()])
        assert as_it_is or re.fullmatch(r"step: recorded and replayed, \d+ calls", training.step.explain())
    assert same(*results)


def test_reads_of_an_unmarked_subclass_are_followed():
    """An attribute that recorded code reads by a computed name is followed; counters record nothing anew."""

    @replayed
    class Wider(Occupancy):
        def sample(self, rays, near, far, **options):
            return super().sample(rays, near, far * getattr(self, "wi" + "de"), **options)

    class Seen(Wider):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            self.wide, self.counts = 1.0, {}

        def step_post_backward(self, output):
            self.steps = getattr(self, "steps", 0) + 1
            self.counts = {**self.counts, self.steps: True}
            super().step_post_backward(output)

    results = []
    for as_it_is in (False, True):
        training = Training(cells=2, sampler=Seen)
        training.train(6, as_it_is=as_it_is)
        recorded = training.recorded
        assert as_it_is or (0 < recorded < 3 and type(training.sampler) is Seen)
        training.sampler.wide = 1.3
        results.append([*training.train(6, as_it_is=as_it_is), *training.everything()])
        assert as_it_is or recorded < training.recorded < recorded + 3
    assert same(*results)


def counted(owner, name):
    """Replaces a method on an object itself by one that counts its calls in the object; returns the count."""
    method, calls = getattr(owner, name), []

    def replaced(*arguments, **options):
        calls.append(1)
        return method(*arguments, **options)

    setattr(owner, name, replaced)
    return calls


@pytest.mark.parametrize(
    "name, of, said",
    [
        ("march", lambda t: t.sampler, "in Python: Occupancy.sample"),
        ("sample", lambda t: t.sampler, "in Python: Occupancy.sample"),
        ("add", lambda t: t.loss.terms[0], "in Python: SparseDepth.add"),
        ("draw", lambda t: t.batches, "in Python: RayBatches.draw"),
        ("step_post_backward", lambda t: t.step.strategy, "in Python: SplitStrategy.step_post_backward"),
        ("zero_grad", lambda t: t.optimizer, "Adam may run Python code"),
        ("_learn", lambda t: t.loss, "RayLoss may run Python code"),
        ("observe", lambda t: t.sampler.grid, "OccupancyGrid may run Python code"),
        ("add", lambda t: t.step.strategy.reservoir, "SampleReservoir may run Python code"),
    ],
)
def test_a_replaced_method_runs_in_each_step(name, of, said):
    training = Training(photograph=True)
    with_strategy(training, SplitStrategy)
    training.train(3)
    calls = counted(of(training), name)
    training.train(4)
    assert len(calls) == 4 and said in training.step.explain(), training.step.explain()
    delattr(of(training), name)
    training.train(3)
    assert len(calls) == 4 and re.fullmatch(r"step: recorded and replayed, \d+ calls", training.step.explain())


def test_the_step_that_a_scheduler_of_torch_replaces_is_no_obstacle():
    training = Training()
    torch.optim.lr_scheduler.StepLR(training.optimizer, 5)
    assert "step" in vars(training.optimizer)
    training.train(3)
    assert "recorded and replayed" in training.step.explain()


def replace_parameter(training):
    layer = training.router.module.colour
    old, layer.weight = layer.weight, torch.nn.Parameter(2 * layer.weight.detach())
    for group in training.optimizer.param_groups:
        group["params"] = [layer.weight if parameter is old else parameter for parameter in group["params"]]


def move_parameter(training):
    weight = training.router.module.colour.weight
    weight.data = weight.data.clone()


CHANGES = {
    "a parameter": replace_parameter,
    "the memory of a parameter": move_parameter,
    "a frozen parameter": lambda t: t.router.module.colour.weight.requires_grad_(False),
    "the optimiser": lambda t: t.optimizer.load_state_dict(t.optimizer.state_dict()),
    "a group": lambda t: t.optimizer.param_groups[0].update(eps=1e-3),
    "the loss": lambda t: setattr(t.loss, "robust", 0.1),
    "the sampler": lambda t: setattr(t.sampler, "samples", 16),
    "forget": lambda t: t.step.forget(),
}


@pytest.mark.parametrize("place", ["rays", "term", "strategy"])
@pytest.mark.parametrize("name", CHANGES)
def test_changes_within_a_step_take_effect_at_once(name, place):
    """A hook before, between or after the recorded segments changes something, in the first or in a later step."""
    for at in (1, 4):
        results = []
        for as_it_is in (False, True):
            training = Training(cells=2)
            changing(training, place, at, CHANGES[name])
            steps = training.train(7, as_it_is=as_it_is)
            results.append([*steps, *(tensor for tensor in training.everything() if tensor is not None)])
            assert training.done == 7 and (as_it_is or "recorded and replayed" in training.step.explain())
        assert same(*results), at


def changing(training, place, at, change):
    """Lets a hook at a place in the step call ``change(training)`` in its call number ``at``."""

    def call():
        training.done += 1
        if training.done == at:
            change(training)

    if place == "rays":
        draw = training.batches.draw
        training.batches.draw = lambda *arguments: (call(), draw(*arguments))[1]
    elif place == "term":
        training.loss.terms = (*training.loss.terms, lambda rays, batch: (call(), clear(rays, batch))[1])
    else:
        with_strategy(training, type("Changing", (SplitStrategy,), {"step_post_backward": lambda _, output: call()}))


def test_a_step_within_its_own_hook_is_refused():
    training = Training()
    training.loss.terms = (lambda rays, batch: training.step(8).loss,)
    for _ in range(2):
        with pytest.raises(RuntimeError, match="a step must not be called while it runs, by one of its hooks"):
            training.step(64)
    training.loss.terms = ()
    training.train(3)
    assert "recorded and replayed" in training.step.explain()


@pytest.mark.parametrize("hooks", [False, True])
@pytest.mark.parametrize("of", [copy.copy, copy.deepcopy, lambda step: pickle.loads(pickle.dumps(step))])
def test_a_copy_of_a_step_has_recordings_of_its_own(of, hooks):
    """A deep copy trains a copy of the networks, exactly like the original; a shallow copy trains the same networks."""
    training = Training(cells=2)
    if hooks:
        with_strategy(training)
    training.train(3)
    copied, before = of(training.step), [tensor.clone() for tensor in training.router.parameters()]
    assert copied.explain() == "step: will be recorded"
    outcomes = [float(copied(64).loss) for _ in range(4)]
    assert "recorded and replayed" in copied.explain()
    shares = copied.optimizer is training.optimizer
    assert shares == (of is copy.copy) and shares != same([*training.router.parameters()], before)
    if not shares:
        assert outcomes == [float(training.step(64).loss) for _ in range(4)]
        assert same([*copied.loss.renderer.field.parameters()], [*training.router.parameters()])
