"""Tests of evaluations during training: the time they take, warnings about poor scores, and invalid steps."""

import functools
import json
import math
import re
from dataclasses import replace

import pytest
import torch
from helpers import refuses, same, trained
from tiny_runs import Each, small, started, steps_of

from voronerf.app.render.camera import render_camera
from voronerf.app.scenes import builtin_scene
from voronerf.app.train import Checkpoints, Divergence, Scores, TrainConfig, TrainingError, build, run
from voronerf.app.train.callbacks import views_of, why_scores_are_poor
from voronerf.app.train.defaults import resolve
from voronerf.app.train.run_directory import write_curve


def weights(state):
    return [parameter.detach().clone() for parameter in state.router.parameters()]


class Clock:
    """A simulated clock: a step reads it twice and takes 1 s, and a view takes `view_seconds`.

    A part of a view takes less time, in proportion to its pixels.
    """

    def __init__(self, monkeypatch, view_seconds):
        self.now, self.read, self.views, pixels = 0.0, 0, [], SIDE**2
        render = render_camera

        def slow(renderer, scene, cameras, index, **options):
            self.views.append(cameras.width)
            self.now += view_seconds(self.now) * cameras.width * cameras.height / pixels
            return render(renderer, scene, cameras, index, **options)

        monkeypatch.setattr("voronerf.app.evaluate.scores.render_camera", slow)

    def __call__(self):
        self.read += 1
        self.now += self.read % 2 == 0
        return self.now


SIDE = 96


@functools.cache
def eight_views():
    return builtin_scene(SIDE, train_views=2, test_views=8)


def scored(monkeypatch, view_seconds, **settings):
    """Returns (state, scores, clock) of a training with a budget of 40 s and steps of 1 s."""
    clock = Clock(monkeypatch, view_seconds)
    settings = {"steps": None, "budget": 40.0, "eval_views": None, "evaluations": 4, **settings}
    state = build(small(**settings), eight_views())
    scores = Scores(None, clock=lambda: clock.now)
    run(state, [scores], clock=clock)
    return state, scores, clock


@pytest.mark.parametrize("seconds", [0.1, 0.3, 1.0, 3.0, 20.0])
def test_evaluations_take_a_tenth_of_the_budget(monkeypatch, seconds):
    """If views are slow, fewer views are scored, or views only at the end, or only the middle of one view."""
    state, scores, clock = scored(monkeypatch, lambda now: seconds)
    spent = clock.now - state.seconds
    views = [line["views"] for line in scores.metrics]
    assert spent <= 4 + seconds / 9 and 38 <= clock.now <= 42.5  # the first view is timed
    assert scores.summary["complete"] and scores.summary["views"] >= 1 and scores.summary["psnr"] > 0
    assert (scores.summary["part"] == 1) == (seconds <= 3)
    assert len(views) == (4 if seconds < 1 else 2 if seconds < 3 else 1)


def test_the_middle_of_several_views_is_scored_where_time_is_short_for_one(monkeypatch):
    _, scores, _ = scored(monkeypatch, lambda now: 8.0)
    assert scores.summary["part"] < 1 and scores.summary["views"] > 1
    line = {"psnr": 20.0, "views": 4, "part": 1 / 9}
    assert views_of(line) == "the middle 11% of 4 views" and views_of({"views": 1, "part": 1}) == "1 view"
    config = TrainConfig(lr=0.01)
    assert why_scores_are_poor([{"psnr": 30.0, "part": 1}, line], config, 25.0, settled=True) is None


def test_views_that_become_cheaper_are_scored_later(monkeypatch):
    """Views are scored once they are cheap: early views are slow since empty space is not known yet."""
    _, scores, clock = scored(monkeypatch, lambda now: 2.0 if now < 25 else 0.1)
    assert [line["views"] for line in scores.metrics] == [8, 8] and min(clock.views) < SIDE
    assert scores.metrics[0]["seconds"] > 25 and {line["part"] for line in scores.metrics} == {1}


def test_views_that_are_asked_for_are_scored_beside_the_budget(monkeypatch):
    state, scores, _ = scored(monkeypatch, lambda now: 20.0, eval_views=2)
    assert state.evaluation_seconds == 0 and 39 <= state.seconds <= 41
    assert [line["views"] for line in scores.metrics] == [2, 2, 2, 2]


def test_evaluations_change_no_bit_of_a_training(scene):
    """Any number of evaluations, of whole views or of their middle, leaves the training the same bit for bit."""
    results = []
    for evaluations, middle in ((1, False), (4, False), (4, True)):
        state = build(small(steps=24, evaluations=evaluations), scene)
        scores = Scores(None)
        looks = Each(lambda state, scores=scores, middle=middle: scores._probe(state, 2) if middle else None)
        run(state, [scores, looks])
        results.append(weights(state))
    assert same(results[0], results[1]) and same(results[0], results[2])


def test_as_many_panels_are_drawn_as_a_tenth_of_the_budget_allows(monkeypatch):
    _, scores, _ = scored(monkeypatch, lambda now: 1.5)
    assert [scores.affordable(budget, 4) for budget in (None, 5.0, 40.0, 400.0)] == [4, 1, 2, 4]


def test_evaluations_of_a_number_of_steps_do_not_depend_on_time(monkeypatch):
    _, scores, _ = scored(monkeypatch, lambda now: 20.0, steps=20, budget=None, evaluations=2)
    assert [(line["step"], line["views"]) for line in scores.metrics] == [(10, 8), (20, 8)]


def test_a_stop_in_the_last_step_leaves_nothing_out(tmp_path, scene):
    summary = trained(small(tmp_path, evaluations=1), scene, stop_at=24)
    assert summary["complete"] and summary["views"] == 2 and summary["psnr"] > 0


def test_infinite_scores_are_null_in_files(tmp_path, scene, monkeypatch):
    monkeypatch.setattr("voronerf.app.evaluate.scores.psnr", lambda image, truth: torch.tensor(math.inf))
    config = small(tmp_path)
    for resume, now in ((False, config), (True, replace(config, steps=26))):
        assert trained(now, scene, resume=resume)["psnr"] == math.inf
        for name in ("metrics.jsonl", "summary.json"):
            text = (tmp_path / name).read_text()
            for value in [text] if name == "summary.json" else text.splitlines():
                entries = json.loads(value, parse_constant=pytest.fail)
                assert entries["psnr"] is None
                assert entries["not_finite"] == {"psnr": "inf", "psnr_of_mean_error": "inf"}
        assert write_curve(tmp_path) is None
    for line, message in (
        ('{"step": "x"}', "step must be an integer, got 'x'"),
        ('{"step": 2, "psnr": "x"}', "psnr must be a number or null, got 'x'"),
        ('{"step": 2}', "psnr must be a number or null, got 'none'"),
    ):
        (tmp_path / "metrics.jsonl").write_text(line)
        refuses(f"metrics.jsonl: line 1: {message}", trained, config, scene, resume=True)


@pytest.mark.parametrize(("field", "value"), [("nerf", math.inf), ("hashgrid", math.nan), ("hashgrid", 1e19)])
def test_a_step_with_such_a_gradient_is_skipped_and_counted(scene, field, value):
    state = started(scene, 1, field=field, depth=1, cells=())
    bias = next(p for name, p in state.router.named_parameters() if name.endswith("bias"))
    hook = bias.register_hook(lambda gradient: gradient + value)
    before, moment = weights(state), state.optimizer.state[bias]["exp_avg_sq"].clone()
    steps_of(state, 1)
    assert same(before, weights(state)) and same([moment], [state.optimizer.state[bias]["exp_avg_sq"]])
    hook.remove()
    steps_of(state, 3)
    assert state.skipped == 1 and not same(before, weights(state))


@pytest.mark.parametrize("harm", ["weights", "moments"])
def test_a_diverged_run_ends_with_its_last_checkpoint(tmp_path, scene, harm):
    def spoil(state):
        if state.step == 16:
            parameter = next(iter(state.router.parameters()))
            with torch.no_grad():
                (parameter if harm == "weights" else state.optimizer.state[parameter]["exp_avg_sq"]).fill_(torch.inf)

    state, checkpoints = build(small(tmp_path, steps=60), scene), Checkpoints(tmp_path, interval=1e-9)
    said = r"not finite, at step \d+; .* too high, try --lr 0.005; the last checkpoint is unchanged"
    with pytest.raises(TrainingError, match=said):
        run(state, [Divergence(tmp_path), checkpoints, Each(spoil)])
    checkpoints.writer.wait()
    assert trained(state.config, scene, resume=True)["complete"]


def test_a_run_that_diverges_before_its_first_checkpoint_ends(tmp_path, scene):
    state = started(scene, 4, cells=())
    with torch.no_grad():
        next(iter(state.router.parameters())).fill_(torch.nan)
    with pytest.raises(TrainingError, match=r"10 consecutive steps are not finite, at step 14; .* no checkpoint"):
        run(state, [Divergence(tmp_path)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("psnrs", "lr", "settled", "said"),
    [
        ([12.0, 20.0, 17.0], None, True, None),
        ([12.0, 20.0, 14.9], 0.1, False, "psnr fell from 20.00 to 14.90 dB: .* too high, try --lr 0.02, the default$"),
        ([20.0, 14.9], 0.004, False, "psnr fell from .* too high, try --lr 0.001$"),
        ([3.0], 1.0, False, None),
        (
            [3.0],
            1.0,
            True,
            "nothing is learnt: psnr is 3.00 dB, where a single colour gives 9.00; .* too high, try --lr 0.02, .*",
        ),
        ([11.9], 1.0, True, "little is learnt: psnr is 11.90 dB, .* 9.00; .* too high, try --lr 0.02, the default$"),
        ([8.9], 1e-3, True, "nothing is learnt: .* too low, try --lr 0.02, the default, or cameras, near and far"),
        ([12.1], 1e-3, True, None),
        ([8.9, 8.9], None, True, "nothing is learnt: .* try --lr 0.005, or cameras, near and far do not fit"),
        ([None, 9.5], None, True, None),
    ],
)
def test_poor_scores_are_told_with_their_likely_cause(scene, psnrs, lr, settled, said):
    config = resolve(TrainConfig(lr=lr), scene)
    cause = why_scores_are_poor([{"psnr": psnr} for psnr in psnrs], config, 9.0, settled=settled)
    assert cause is None if said is None else re.search(said, cause)
