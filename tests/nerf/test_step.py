"""A training step that is recorded and replayed."""

import threading
from itertools import pairwise

import pytest
import torch

from voronerf import HashGridField, OccupancyGrid, VoronoiRouter
from voronerf.nerf import (
    Adam,
    DirectionPerSample,
    Occupancy,
    PlannedSplit,
    RayBatches,
    RayLoss,
    Renderer,
    SplitStrategy,
    TrainingStep,
    orbit_cameras,
)
from voronerf.ops import Guard
from voronerf.ops._core.recording import Recording

pytestmark = pytest.mark.native
BOX = torch.tensor([[-1.0, -1, -1], [1, 1, 1]])


class Training:
    """A small training, whose grid empties a part of the box, so that its numbers of samples vary.

    As of a photograph it has points of a sparse model, and rays from where no camera was.
    """

    def __init__(self, cells=1, field=None, sampler=Occupancy, photograph=False, **options):
        torch.manual_seed(0)
        cameras = orbit_cameras(3, radius=3.0, elevation=0.3, width=16, height=16, focal=16.0)
        images = torch.randint(256, (3, 16, 16, 3), dtype=torch.uint8)
        points = torch.arange(0, 768, 7), torch.full((110,), 3.0)
        where = {"unseen": 0.5, "sparse": points} if photograph else {"box": BOX}
        self.batches = RayBatches(cameras, images, near=1.0, far=5.0, background=torch.ones(3), **where)
        own, field = field, field() if field else HashGridField(levels=4, log2_entries=10, width=16)
        share = ["features"] if isinstance(field, HashGridField) else []
        options = {"share": share, **options}
        self.router = VoronoiRouter(field, torch.rand(cells, 3) - 0.5, coords="first3", **options)
        grid = OccupancyGrid.for_training(BOX, 32, resolution=16)
        grid.density[:6] = grid.occupied[:6] = 0
        self.sampler = sampler(grid, 32)
        shown = self.router if own is None else DirectionPerSample(self.router)
        self.loss = RayLoss(Renderer({"field": shown}, self.sampler), smooth_depth=0.1, sparse_depth=0.3)
        self.optimizer = Adam.of({"field": self.router}, lr=0.01, sparse=["features"])
        self.guard, self.generator = Guard.on("cpu"), torch.Generator().manual_seed(1)
        given = {"guard": self.guard, "generator": self.generator}
        self.step = TrainingStep(self.batches, self.loss, self.optimizer, **given)
        self.recorded = 0
        record = self.step._record
        self.step._record = lambda *of: (setattr(self, "recorded", self.recorded + 1), record(*of))[1]

    def train(self, steps, rays=lambda step: 64, as_it_is=False):
        """Steps, of which some are as they are; gives what they have found."""
        found = []
        for step in range(steps):
            if as_it_is:
                self.step.forget()
                self.step._standing_obstacle = lambda: "a test"
            self.optimizer.set_learning_rate(0.01 / (1 + step))
            made = self.step(rays(step))
            output = made.output
            kept = made.loss, output.weights, output.samples.ray_index, output.colour, made.batch.target
            found += [*(each.clone() for each in kept), torch.tensor([made.rays, made.samples])]
        return found

    def everything(self):
        moments = [value for each in self.optimizer.state.values() for value in each.values()]
        grid = self.sampler.grid
        gradients = [p.grad for p in self.router.parameters()]
        return [*self.router.parameters(), *gradients, *moments, grid.density, grid.occupied, *self.guard[:3]]


def same(one, other):
    return len(one) == len(other) and all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.fixture(params=[1, 2, 5])
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize(("cells", "photograph"), [(1, False), (6, False), (6, True)])
def test_same_bits_as_steps_that_run_as_they_are(cells, photograph, threads):
    """Parameters, moments, grid, and all that a step gives; rays grow beyond what there is memory for, and shrink."""

    def rays(step):
        return 64 + 5 * step if step < 30 else 150 - 3 * (step - 30)

    one, other = Training(cells, photograph=photograph), Training(cells, photograph=photograph)
    found, expected = one.train(60, rays), other.train(60, rays, as_it_is=True)
    assert same(found, expected) and same(one.everything(), other.everything())
    assert "replayed" in one.step.explain() and one.recorded < 12, one.recorded
    assert "a test" in other.step.explain()


def test_more_samples_than_there_is_memory_for(monkeypatch):
    """Such a step draws the same numbers again, as it is, and is recorded anew."""
    found = []
    for as_it_is in (False, True):
        training = Training()
        training.sampler.grid.occupied[:] = False
        training.sampler.grid.occupied[8:10] = True
        training.sampler.grid.density[:] = 0
        training.sampler.grid.density[8:10] = 1e3
        steps = training.train(5, as_it_is=as_it_is)
        before = training.recorded
        training.sampler.grid.occupied[:] = True
        steps += training.train(5, as_it_is=as_it_is)
        assert as_it_is or training.recorded == before + 1
        found.append([*steps, *training.everything()])
    assert same(*found)


def test_more_and_more_samples_and_none():
    """Step after step beyond the memory, then no samples at all, and some again."""
    found = []
    for as_it_is in (False, True):
        training, steps = Training(), []
        grid = training.sampler.grid
        for slices in (1, 1, 1, 1, 2, 4, 8, 16, 16, 0, 0, 3, 3, 3):
            grid.occupied[:] = False
            grid.occupied[:slices] = True
            grid.density[:] = 0
            grid.density[:slices] = 1e3
            steps += training.train(1, as_it_is=as_it_is)
        found.append([*steps, *training.everything()])
        counts = [each[1].item() for each in steps[5::6]]
        assert counts[9] == 0 and all(1.25 * before + 64 < now for before, now in pairwise(counts[4:8])), counts
    assert same(*found)


@pytest.mark.parametrize("cells", [1, 6])
def test_steps_in_one_call_are_the_same_bits(cells, threads, monkeypatch):
    """With what sampler and optimiser do before and after them; parts of a call may exceed the memory."""
    monkeypatch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 96)  # a multiple of the steps of a call
    found = []
    for calls in ([16] * 14, [1] * 224, [5, 11, 3, 13] * 7):
        training, done = Training(cells), 0
        training.optimizer.average, grid = 0.9, training.sampler.grid
        for steps in calls:
            if done == 160:  # many more samples, as a call of 16 goes on
                grid.density[:], grid.occupied[:] = 1e3, True
            training.optimizer.set_learning_rate(0.01 / (1 + done // 16))
            made = training.step(40 + done // 16, steps, at=done)
            done += steps
        assert "replayed" in training.step.explain() and set(training.step._parts) == {"before", "after"}
        with training.optimizer.averaged():
            shown = [p.detach().clone() for p in training.router.parameters()]
        found.append([made.loss, made.output.weights, *shown, *training.everything()])
    assert same(found[0], found[1]) and same(found[0], found[2])


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match="TrainingStep: steps must be >= 1, got 0"):
        Training().step(64, 0)


def test_gradients_are_there_after_each_step():
    """Also where a loop drops them, or a step in between was not replayed."""
    one, other = Training(), Training()
    for training, as_it_is in ((one, False), (other, True)):
        training.train(5, as_it_is=as_it_is)
        training.optimizer.zero_grad()
        training.train(1, as_it_is=as_it_is)
        training.kept = [p.grad.clone() for p in training.router.parameters()]
        with torch.autograd.profiler.profile():
            training.train(1, as_it_is=as_it_is)
        training.train(3, as_it_is=as_it_is)
    assert same(one.kept, other.kept) and same(one.everything(), other.everything())


def test_numbers_of_rows_that_are_much_the_same():
    """A tensor may have one row more than there are rays."""
    with Recording() as recording:
        recording.count(lambda: 8)
        recording.count(lambda: 9)
    assert recording.obstacle == "two numbers of rows are much the same, 9"


@pytest.mark.parametrize(
    "change",
    [
        lambda t: setattr(t.sampler, "samples", 16),
        lambda t: setattr(t.sampler, "settling", True),
        lambda t: setattr(t.batches, "background", torch.zeros(3)),
        lambda t: setattr(t.sampler, "grid", OccupancyGrid.for_training(BOX, 32, resolution=8)),
        lambda t: t.router.freeze([0, 2]),
        lambda t: t.router.subdivide(2, points=torch.rand(500, 3), weights=torch.ones(500), optimizer=t.optimizer),
        lambda t: t.optimizer.param_groups[0].update(betas=(0.5, 0.6)),
        lambda t: t.optimizer.load_state_dict(t.optimizer.state_dict()),
        lambda t: t.optimizer.state.clear(),
        lambda t: t.optimizer.drop_averages(),
        lambda t: t.router.module.colour.weight.requires_grad_(False),
        lambda t: t.router.module.colour.weight.register_hook(lambda gradient: 2 * gradient),
        lambda t: t.router.module.register_forward_hook(lambda *given: None),
        lambda t: setattr(t.router.module, "density_scale", 3.0),
        lambda t: t.router.to(torch.float64).to(torch.float32),
        lambda t: torch.set_num_threads(3),
        lambda t: setattr(torch.backends.mkldnn.matmul, "fp32_precision", "tf32"),
    ],
)
def test_what_changes_is_followed(change):
    before, found = torch.get_num_threads(), []
    try:
        for as_it_is in (False, True):
            torch.set_num_threads(before)
            torch.set_float32_matmul_precision("highest")
            training = Training(cells=3)
            training.optimizer.average = 0.9
            training.train(4, as_it_is=as_it_is)
            for _ in range(2):
                training.step(64, at=15)
            change(training)
            steps = [*training.train(4, as_it_is=as_it_is), training.step(64, at=15).loss]
            found.append([*steps, *(e for e in training.everything() if e is not None)])
    finally:
        torch.set_num_threads(before)
        torch.set_float32_matmul_precision("highest")
    assert same(*found)


def test_learning_rate_and_averages_follow_the_loop():
    one, other = Training(), Training()
    for training, as_it_is in ((one, False), (other, True)):
        training.optimizer.average = 0.9
        for step in range(40):
            training.train(1, as_it_is=as_it_is)
            training.optimizer.set_learning_rate(0.02 / (1 + step))
            training.optimizer.after_step(step)
        with training.optimizer.averaged():
            training.shown = [p.detach().clone() for p in training.router.parameters()]
        training.train(3, as_it_is=as_it_is)
    assert same(one.shown, other.shown) and same(one.everything(), other.everything())


class Counting(Occupancy):
    """A user's own, which does something in Python."""

    asked = 0

    def sample(self, *given, **more):
        self.asked += 1
        return super().sample(*given, **more)


def test_what_python_does_is_not_lost():
    training = Training(sampler=Counting)
    training.train(6)
    assert training.sampler.asked == 6
    assert "Counting may do in Python what is not seen" in training.step.explain()
    training = Training()
    training.train(2)
    training.loss.term = lambda seen, batch: seen.opacity.mean()
    training.train(1)
    assert "function may do in Python what is not seen" in training.step.explain()


class Torch(torch.nn.Module):
    """A field that is not fused, so its layers are torch's."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(3, 4)

    def forward(self, positions, directions):
        raw = self.layer(positions)
        return raw[:, :3].sigmoid(), torch.nn.functional.softplus(raw[:, 3])


def test_a_field_of_torch_runs_as_it_is():
    training = Training(cells=2, field=Torch)
    training.train(8)
    assert "runs as it is, since Torch.forward is not traced without fuse=True" in training.step.explain()
    assert training.recorded == 0 and int(training.guard.skipped) == 0


def test_a_fused_field_is_replayed():
    """Also where its attributes change."""
    found = []
    for as_it_is in (False, True):
        training = Training(cells=2, field=Scaled, fuse=True, way="fused")
        steps = training.train(6, as_it_is=as_it_is)
        replayed = "replayed" in training.step.explain()
        assert replayed != as_it_is, training.step.explain()
        training.router.module.scale = 3.0
        found.append([*steps, *training.train(6, as_it_is=as_it_is)])
    assert same(*found)


class Scaled(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer, self.scale = torch.nn.Linear(3, 4), 1.0

    def forward(self, positions, directions):
        raw = self.layer(positions)
        return raw[:, :3].sigmoid(), self.scale * torch.nn.functional.softplus(raw[:, 3])


def test_torch_in_a_step_is_named_and_tried_no_longer():
    """Samples for a split that torch keeps: after it steps are replayed."""
    training = Training()
    given = {"field": training.router}, [PlannedSplit(at=8, children=2)]
    training.step.strategy = Keeping(*given, generator=torch.Generator().manual_seed(0))
    training.train(8)
    explained = training.step.explain()
    assert explained == f"step: runs as it is, since torch computes sin, in {__file__.split('/')[-1]}:{Keeping.line}"
    before = training.recorded
    training.train(100)
    assert training.recorded <= before + 7


class Keeping(SplitStrategy):
    __module__ = "voronerf.tests"
    line = 0

    def step_post_backward(self, output):
        Keeping.line = 1 + (lambda: None).__code__.co_firstlineno
        self.seen = output.weights.sin()


def test_a_profiler_sees_the_operations():
    training = Training()
    training.train(5)
    with torch.profiler.profile() as profile:
        training.train(2)
    assert any("voronerf::" in event.name for event in profile.events())
    assert "watches" in training.step.explain()
    training.train(3)
    assert "replayed" in training.step.explain()


def test_two_trainings_in_threads():
    alone = Training()
    expected = [*alone.train(30), *alone.everything()]
    trainings, found = [Training(), Training()], [[], []]

    def run(number):
        found[number] = trainings[number].train(30)

    workers = [threading.Thread(target=run, args=(number,)) for number in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=60)
    for number in range(2):
        assert same([*found[number], *trainings[number].everything()], expected)


def test_a_step_that_is_not_finite_is_left_out():
    training = Training()
    training.train(5)
    before = [p.detach().clone() for p in training.router.parameters()]
    with torch.no_grad():
        training.router.module.colour.bias[0, 0] = float("nan")
    training.train(2)
    assert "replayed" in training.step.explain() and int(training.guard.skipped) == 2
    with torch.no_grad():
        training.router.module.colour.bias[0, 0] = 0.0
    assert same(list(training.router.parameters())[:1], before[:1])


def test_no_rays_are_refused_as_ever():
    training = Training()
    training.train(4)
    with pytest.raises(ValueError, match="draw_pixels: count must"):
        training.step(0)
    training.train(4)
    assert "replayed" in training.step.explain()
