"""Tests of training steps that are recorded and replayed."""

import contextlib
import gc
import re
import threading
import weakref
from itertools import pairwise

import pytest
import torch
from step_training import BOX, Scaled, Training, same

from voronerf import OccupancyGrid, VoronoiDiagram
from voronerf.nerf import PlannedSplit, SplitStrategy, replayed
from voronerf.ops import cell_sort, nearest_centre, spherical_harmonics
from voronerf.ops._core.recording import Recording

pytestmark = pytest.mark.native


@pytest.fixture
def threads(request):
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("cells", "photograph", "threads"), [(1, False, 1), (6, False, 5), (6, True, 2)], indirect=["threads"]
)
def test_same_bits_as_steps_that_run_as_they_are(cells, photograph, threads):
    """Parameters, moments, grid and results are equal bit for bit, also if the rays outgrow the memory or get fewer."""

    def rays(step):
        return 64 + 5 * step if step < 30 else 150 - 3 * (step - 30)

    one, other = Training(cells, photograph=photograph), Training(cells, photograph=photograph)
    actual, expected = one.train(60, rays), other.train(60, rays, as_it_is=True)
    assert same(actual, expected) and same(one.everything(), other.everything())
    assert "replayed" in one.step.explain() and one.recorded < 12, one.recorded
    assert "a test" in other.step.explain()


def test_more_and_more_samples_and_none():
    """Several steps in a row outgrow the memory; then steps have no samples, and later steps have some."""
    results = []
    for as_it_is in (False, True):
        training, steps = Training(), []
        grid = training.sampler.grid
        for slices in (1, 1, 1, 1, 2, 4, 8, 16, 16, 0, 0, 3, 3, 3):
            grid.occupied[:] = False
            grid.occupied[:slices] = True
            grid.density[:] = 0
            grid.density[:slices] = 1e3
            steps += training.train(1, as_it_is=as_it_is)
        results.append([*steps, *training.everything()])
        counts = [output[1].item() for output in steps[5::6]]
        assert counts[9] == 0 and all(1.25 * before + 64 < now for before, now in pairwise(counts[4:8])), counts
    assert same(*results)


@pytest.mark.parametrize(("cells", "threads"), [(1, 1), (6, 2), (6, 5)], indirect=["threads"])
def test_steps_in_one_call_are_the_same_bits(cells, threads):
    """The hooks before and after steps run too, and steps in the middle of a call may exceed the memory."""
    results = []
    for calls in ([16] * 14, [1] * 224, [5, 11, 3, 13] * 7):
        training, done = Training(cells), 0
        training.optimizer.average, grid = 0.9, training.sampler.grid
        for steps in calls:
            if done == 160:  # many more samples, after ten calls of 16 steps
                grid.density[:], grid.occupied[:] = 1e3, True
            training.optimizer.set_learning_rate(0.01 / (1 + done // 16))
            result = training.step(40 + done // 16, steps, at=done)
            done += steps
        replays = training.step._step, training.step._before, training.step._after
        assert all(re.fullmatch(r"recorded and replayed, \d+ calls", replay.explain()) for replay in replays)
        with training.optimizer.averaged():
            shown = [p.detach().clone() for p in training.router.parameters()]
        results.append([result.loss, result.output.weights, *shown, *training.everything()])
    assert same(results[0], results[1]) and same(results[0], results[2])


def test_no_steps_are_refused():
    with pytest.raises(ValueError, match="TrainingStep: steps must be >= 1, got 0"):
        Training().step(64, 0)


def test_a_training_is_freed_with_its_recording():
    """A recording and the step refer to each other; Python's garbage collector finds the cycle."""
    training = Training()
    training.train(6)
    assert training.recorded
    parts = [weakref.ref(part) for part in (training.step, training.router, training.loss, training.optimizer)]
    del training
    gc.collect()
    assert [part() for part in parts] == [None] * 4


def test_gradients_are_there_after_each_step():
    """Gradients exist, also if the loop has dropped them or an earlier step was not replayed."""
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


def test_numbers_of_rows_that_were_the_same():
    """A replay distinguishes two row counts that were equal in the recording."""
    centres = torch.rand(5, 3)
    with Recording() as recording:
        results = [nearest_centre(recording.take(torch.rand(6, 3)), centres) for _ in range(2)]
    for rows in ((4, 7), (7, 6), (6, 6)):
        points = [torch.rand(count, 3) for count in rows]
        assert recording.replay(1, inputs=points) == 1
        for cells, arguments in zip(recording.now(results), points, strict=True):
            assert torch.equal(cells, nearest_centre(arguments, centres))


def test_a_number_of_rows_that_is_no_count_is_refused():
    """A recording refuses a row count that is a plain int, since a replay cannot read the count again.

    The replay would use the recorded number of rows, or write beyond the end of memory that has fewer rows.
    """
    points, centres = torch.rand(6, 3), torch.rand(5, 3)
    with Recording() as recording:
        nearest_centre(points, centres)
    assert recording.obstacle == "a row count is a plain int that a replay cannot read again: 6"
    with Recording() as recording:
        taken = recording.take(points)
        taken.new_empty(taken.shape)
    assert recording.obstacle.startswith("memory of 6 rows was allocated without a RowCount, in test_step.py:")
    with Recording() as recording:
        spherical_harmonics(recording.take(points), 2)
    assert recording.obstacle == "encode has no RowCount among its arguments"


def test_torch_entry_by_entry_is_computed_again():
    """Replays repeat pointwise operations of torch on tensors of rows and on column slices, in place or not."""
    with Recording() as recording:
        x = recording.take(torch.rand(6, 3))
        y = torch.sigmoid(x[:, 1]) * 2
        x[:, :2].addcmul_(y[:, None], y[:, None], value=3.0)
    for rows in (5, 7, 6):
        arguments = torch.rand(rows, 3)
        assert recording.replay(1, inputs=[arguments]) == 1
        expected = arguments.clone()
        own = torch.sigmoid(expected[:, 1]) * 2
        expected[:, :2].addcmul_(own[:, None], own[:, None], value=3.0)
        assert same(recording.now([x, y]), [expected, own])
    for refused in (lambda x: x.t() + 1, lambda x: x[:, 0] + x.new_empty(2, 6), torch.bernoulli, torch.sum):
        with Recording() as recording:
            refused(recording.take(torch.rand(6, 3)))
        assert recording.obstacle.startswith("torch "), refused


def test_a_replay_refuses_what_a_call_finds_wrong():
    """A replay refuses cells that have become out of range, like a call does."""
    cells = torch.tensor([0, 2, 1, 2, 0, 1], dtype=torch.int32)
    with Recording() as recording:
        order, _ = cell_sort(recording.take(cells), 3)
    assert recording.obstacle is None and recording.replay(1, inputs=[cells]) == 1
    cells[3] = 5
    with pytest.raises(ValueError, match="cell_sort: arguments must be valid in a replay"):
        recording.replay(1, inputs=[cells])
    cells[3] = 0
    assert recording.replay(1, inputs=[cells]) == 1 and order.tolist() == [0, 3, 4, 2, 5, 1]


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
        lambda t: t.optimizer.param_groups[0]["betas"].__setitem__(0, 0.5),
        lambda t: t.optimizer.load_state_dict(t.optimizer.state_dict()),
        lambda t: t.optimizer.state.clear(),
        lambda t: t.router.module.colour.weight.requires_grad_(False),
        lambda t: t.router.module.colour.weight.register_hook(lambda gradient: 2 * gradient),
        lambda t: t.router.module.register_forward_hook(lambda *arguments: None),
        lambda t: setattr(t.router.module, "density_scale", 3.0),
        lambda t: t.router.to(torch.float64).to(torch.float32),
        lambda t: torch.set_num_threads(3),
        lambda t: setattr(torch.backends.mkldnn.matmul, "fp32_precision", "tf32"),
        lambda t: setattr(t.sampler.grid, "threshold", 30 * t.sampler.grid.threshold),
        lambda t: t.sampler.grid.load_state_dict({k: v.clone() for k, v in t.sampler.grid.state_dict().items()}),
    ],
)
def test_what_changes_is_followed(change):
    before, results = torch.get_num_threads(), []
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
            results.append([*steps, *(e for e in training.everything() if e is not None)])
    finally:
        torch.set_num_threads(before)
        torch.set_float32_matmul_precision("highest")
    assert same(*results)


def new_data(*tensors):
    """Moves tensors to other memory and keeps their values, except that images (uint8) are inverted."""
    for tensor in tensors:
        tensor.data = 255 - tensor.data if tensor.dtype == torch.uint8 else tensor.data.clone()


def new_vector(training):
    """Puts all parameters into one piece of memory."""
    parameters = list(training.router.parameters())
    torch.nn.utils.vector_to_parameters(torch.nn.utils.parameters_to_vector(parameters), parameters)


#: Functions that move tensors to other memory or to another layout, and keep the tensor objects.
MOVES = {
    "gradients": lambda t: new_data(*(p.grad for p in t.router.parameters() if p.grad is not None)),
    "moments": lambda t: new_data(*(state["exp_avg"] for state in t.optimizer.state.values())),
    "steps": lambda t: new_data(*(state["step"] for state in t.optimizer.state.values())),
    "averages": lambda t: new_data(*(state["average"] for state in t.optimizer.state.values())),
    "densities": lambda t: new_data(t.sampler.grid.density),
    "occupied voxels": lambda t: new_data(t.sampler.grid.occupied),
    "transposed images": lambda t: setattr(t.batches.images, "data", t.batches.images.data.transpose(1, 2)),
    "transposed images in place": lambda t: t.batches.images.transpose_(1, 2),
    "one image for all": lambda t: setattr(t.batches.images, "data", t.batches.images.data[:1].expand(3, -1, -1, -1)),
    "images": lambda t: new_data(t.batches.images),
    "background": lambda t: setattr(t.batches.background, "data", torch.tensor([0.5, 0.0, 1.0])),
    "centres": lambda t: setattr(t.router.diagram.centres, "data", t.router.diagram.centres.data.flip(0)),
    "one pose": lambda t: setattr(t.batches.cameras.poses, "data", t.batches.cameras.poses.data[:1].expand(3, -1, -1)),
    "poses": lambda t: setattr(t.batches.cameras.poses, "data", t.batches.cameras.poses.data.flip(0)),
    "parameters": lambda t: new_data(*t.router.parameters()),
    "a vector": new_vector,
    "a parameter that does not learn": lambda t: new_data(t.router.module.density.bias),
    "guard": lambda t: new_data(*t.guard[:3]),
    "shared memory": lambda t: t.router.module.density.weight.share_memory_(),
    "set": lambda t: t.sampler.grid.density.set_(t.sampler.grid.density.clone()),
}


def test_what_moves_is_followed():
    """After a tensor has moved, a step uses its new memory and does not write to the old memory."""
    results = []
    for as_it_is in (False, True):
        training, steps = Training(cells=3), {}
        training.router.module.density.bias.requires_grad_(False)
        training.optimizer.average = 0.9
        for name, move in {"nothing": lambda t: None, **MOVES}.items():
            for _ in range(2):  # the first step is recorded, the second replayed
                training.train(1, as_it_is=as_it_is)
                training.step(64, 2, at=1023)
            recorded = training.recorded
            move(training)
            steps[name] = [*training.train(1, as_it_is=as_it_is), training.step(64, 2, at=1023).loss.clone()]
            still = name in ("averages", "nothing")  # only the segment after a step uses averages
            assert as_it_is or (training.recorded > recorded) != still, name
            steps[name] += [tensor.detach().clone() for tensor in training.everything() if tensor is not None]
        results.append(steps)
    for name, steps in results[0].items():
        assert same(steps, results[1][name]), name


def test_centres_that_have_an_index_are_followed():
    """Steps use the current centres after a change in place, a move to other memory, or a new diagram."""
    results = []
    for as_it_is in (False, True):
        training, steps = Training(cells=2100), []
        for change in (
            lambda t: None,
            lambda t: t.router.diagram.centres.mul_(0.7),
            MOVES["centres"],
            lambda t: setattr(t.router, "diagram", VoronoiDiagram(t.router.diagram.centres.flip(0) + 0.1)),
        ):
            training.train(1, as_it_is=as_it_is)
            training.step(64, 2, at=1023)
            change(training)
            steps += training.train(2, as_it_is=as_it_is)
        results.append([*steps, *training.router.parameters()])
        assert as_it_is or "recorded and replayed" in training.step.explain()
    assert same(*results)


def test_recordings_that_are_never_replayed_are_made_less_often():
    training = Training()
    training.train(4)
    said = []
    for _ in range(12):
        new_data(training.batches.images)
        training.train(1)
        said.append(training.step.explain())
    assert training.recorded < 8 and any("runs eagerly for 3 more steps" in text for text in said), said
    training.train(8)
    assert "recorded and replayed" in training.step.explain()


def test_gradients_that_were_dropped_are_given_back():
    """A step restores its own gradient tensors after the loop has changed ``grad`` attributes.

    The loop has set a gradient to None, replaced a gradient, and assigned a gradient to a frozen parameter.
    """
    one, other = Training(), Training()
    for training, as_it_is in ((one, False), (other, True)):
        list(training.router.parameters())[-2].requires_grad_(False)
        training.train(5, as_it_is=as_it_is)
        recorded, parameters = training.recorded, list(training.router.parameters())
        parameters[3].grad, parameters[-1].grad = None, torch.zeros_like(parameters[-1])
        parameters[-2].grad = torch.zeros_like(parameters[-2])
        training.train(1, as_it_is=as_it_is)
        assert as_it_is or training.recorded == recorded
        assert parameters[-2].grad is None
    arguments = ([tensor for tensor in training.everything() if tensor is not None] for training in (one, other))
    assert same(*arguments)


def test_hooks_in_the_place_of_earlier_ones_are_called():
    def post(parameter, hook):
        return parameter.register_post_accumulate_grad_hook(lambda parameter: hook(parameter.grad))

    calls = []
    for register in (torch.Tensor.register_hook, post):
        training = Training()
        parameter = training.router.module.colour.weight
        register(parameter, lambda gradient: None).remove()
        training.train(3)
        assert "replayed" in training.step.explain()
        calls.clear()
        handle = register(parameter, lambda gradient: calls.append(gradient.shape))
        training.train(5)
        assert calls == 5 * [parameter.shape], register
        handle.remove()
        training.train(8)
        assert "replayed" in training.step.explain() and len(calls) == 5


def test_steps_without_gradients_are_refused_as_ever():
    training = Training()
    training.train(3)
    with torch.no_grad(), pytest.raises(RuntimeError, match="does not require grad"):
        training.train(1)
    training.train(2)
    assert "replayed" in training.step.explain()


@pytest.mark.parametrize("field", [None, "another"])
def test_a_second_optimizer_learns(field):
    """`explain` names a parameter that only another optimizer has; the steps of that optimizer move the parameter."""
    moved = []
    for as_it_is in (False, True):
        training = Training(field=Scaled, fuse=True) if field else Training()
        module = training.router.module
        name, parameter = ("layer.bias", module.layer.bias) if field else ("density.bias", module.density.bias)
        group = training.optimizer.param_groups[0]
        group["params"] = [p for p in group["params"] if p is not parameter]
        other, values = torch.optim.SGD([parameter], lr=1.0), []
        for step in range(6):
            training.train(1, as_it_is=as_it_is)
            if step % 2:  # gradients accumulate between these steps
                other.step()
                other.zero_grad()
            values.append(parameter.detach().clone())
        moved.append(values)
        prefix = "network.module." if field else "module."
        if not as_it_is:
            says = f"step: runs eagerly, since {prefix}{name} needs a gradient but is not in the optimizer"
            assert training.step.explain() == says
            parameter.requires_grad_(False)
            training.train(2)
            assert "replayed" in training.step.explain()
    assert same(*moved) and all(not torch.equal(*moved[0][i : i + 3 : 2]) for i in (1, 3))


@pytest.mark.parametrize(("steps", "settled"), [(6, 0), (7, 64), (10, 0), (32, 64)])
def test_any_number_of_steps_of_a_call_keeps_averages_and_decay(steps, settled):
    """The grid is also first updated at the right step, in the middle of a call or once its field has learnt."""
    results = []
    for calls in (96 // steps * [steps] + [96 % steps], 96 * [1]):
        training, done = Training(cells=2), 0
        training.optimizer.average, answers = 0.9, iter([False, False, True])  # at the steps 40, 48 and 64
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("voronerf.nerf.samplers.WARMUP_STEPS", 40)
            if settled:
                training.sampler.grid.settled = None
                patch.setattr(OccupancyGrid, "can_learn_from", lambda *_, answers=answers, **__: next(answers))
            for count in filter(None, calls):
                training.step(64, count, at=done)
                done += count
        with training.optimizer.averaged():
            shown = [p.detach().clone() for p in training.router.parameters()]
        results.append([*shown, *training.everything()])
        assert training.sampler.grid.settled == settled
    assert same(*results)


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


class Torch(torch.nn.Module):
    """A field that is not fused, so that torch runs its layers."""

    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(3, 4)

    def forward(self, positions, directions):
        raw = self.layer(positions)
        return raw[:, :3].sigmoid(), torch.nn.functional.softplus(raw[:, 3])


def test_a_field_of_torch_runs_as_it_is():
    training = Training(cells=2, field=Torch)
    training.train(8)
    assert "runs eagerly, since Torch.forward is not traced without fuse=True" in training.step.explain()
    assert training.recorded == 0 and int(training.guard.skipped) == 0


def test_a_fused_field_is_replayed():
    """Replays use changed attributes of the field."""
    results = []
    for as_it_is in (False, True):
        training = Training(cells=2, field=Scaled, fuse=True)
        steps = training.train(6, as_it_is=as_it_is)
        replayed = "replayed" in training.step.explain()
        assert replayed != as_it_is, training.step.explain()
        training.router.module.scale = 3.0
        results.append([*steps, *training.train(6, as_it_is=as_it_is)])
    assert same(*results)


@replayed
class Keeping(SplitStrategy):
    """A split rule that is marked as replayed, although its hook calls a sum of torch."""

    line = 0

    def step_post_backward(self, output):
        Keeping.line = 1 + (lambda: None).__code__.co_firstlineno
        self.seen = output.weights.sum()


def test_torch_in_a_step_is_named_and_tried_no_longer():
    training = Training()
    arguments = {"field": training.router}, [PlannedSplit(at=8, children=2)]
    training.step.strategy = Keeping(*arguments, generator=torch.Generator().manual_seed(0))
    training.train(8)
    explained = training.step.explain()
    assert explained == f"step: runs eagerly, since torch computes sum, in {__file__.split('/')[-1]}:{Keeping.line}"
    before = training.recorded
    training.train(100)
    assert training.recorded <= before + 7


def test_a_profiler_sees_the_operations():
    training = Training()
    training.train(5)
    with torch.profiler.profile() as profile:
        training.train(2)
    assert any("voronerf::" in event.name for event in profile.events())
    assert "profiler of torch is active" in training.step.explain()
    training.train(3)
    assert "replayed" in training.step.explain()


def test_two_trainings_in_threads():
    alone = Training()
    expected = [*alone.train(30), *alone.everything()]
    trainings, actual = [Training(), Training()], [[], []]

    def run(number):
        actual[number] = trainings[number].train(30)

    workers = [threading.Thread(target=run, args=(number,)) for number in range(2)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=60)
    for number in range(2):
        assert same([*actual[number], *trainings[number].everything()], expected)


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


@pytest.mark.parametrize(
    "before",
    [
        lambda training: training.router(torch.rand(9, 3), torch.rand(9, 3)),
        lambda training: training.router.load_state_dict(training.router.state_dict()),
    ],
)
def test_steps_after_inference_mode(before):
    """A router of 2,048 cells, which keeps an index, trains after a call or a change in inference mode."""
    results = []
    for mode in (torch.inference_mode, contextlib.nullcontext):
        training = Training(cells=2048)
        with mode():
            before(training)
        results.append([*training.train(4), *(each for each in training.everything() if each is not None)])
        assert "recorded and replayed" in training.step.explain()
    assert same(*results)
