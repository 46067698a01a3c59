"""Evaluations of a training: within their share of the budget, and with what makes them poor; steps that go wrong."""

import itertools
import json
import math
import re
from dataclasses import replace

import pytest
import torch
from helpers import refuses, same, trained
from tiny_runs import Each, small, started, steps_of

from voronerf.app.train import Checkpoints, Divergence, Scores, TrainConfig, TrainingError, build, run
from voronerf.app.train.callbacks import why_scores_are_poor
from voronerf.app.train.defaults import resolve
from voronerf.app.train.run_directory import write_curve


def weights(state):
    return [parameter.detach().clone() for parameter in state.router.parameters()]


@pytest.mark.parametrize("views", [None, 2])
def test_evaluations_are_part_of_the_budget(tmp_path, scene, views):
    """A second for each step and for each evaluation, whatever its views: a tenth of 40 is four evaluations."""
    seconds = itertools.count()
    config = small(tmp_path, steps=None, budget=40.0, eval_views=views, evaluations=4)
    clock = lambda: float(next(seconds))  # noqa: E731
    state, scores = build(config, scene), Scores(None, clock=clock)
    run(state, [scores], clock=clock)
    if views is None:
        assert state.evaluation_seconds <= 2 and 36 <= state.seconds + state.evaluation_seconds <= 42
        assert scores.summary["complete"] and scores.summary["views"] >= 1
    else:
        assert state.evaluation_seconds == 0 and 40 <= state.seconds <= 44
        assert [line["views"] for line in scores.metrics] == [2, 2, 2, 2]


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
                found = json.loads(value, parse_constant=pytest.fail)
                assert found["psnr"] is None
                assert found["not_finite"] == {"psnr": "inf", "psnr_of_mean_error": "inf"}
        assert write_curve(tmp_path) is None
    (tmp_path / "metrics.jsonl").write_text('{"step": "x"}')
    refuses("metrics.jsonl: line 1: step must be an integer, got 'x'", trained, config, scene, resume=True)


@pytest.mark.parametrize("value", [float("inf"), float("nan"), 1e19])
@pytest.mark.parametrize("field", ["nerf", "hashgrid"])
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

    state, checkpoints = build(small(tmp_path, steps=60), scene), Checkpoints(tmp_path, every=1e-9)
    with pytest.raises(
        TrainingError, match=r"not finite at step \d+, try a smaller --lr; the last checkpoint is as it"
    ):
        run(state, [Divergence(tmp_path), checkpoints, Each(spoil)])
    checkpoints.writer.wait()
    assert trained(state.config, scene, resume=True)["complete"]


def test_a_run_that_diverges_before_its_first_checkpoint_ends(tmp_path, scene):
    state = started(scene, 4, cells=())
    with torch.no_grad():
        next(iter(state.router.parameters())).fill_(torch.nan)
    with pytest.raises(TrainingError, match=r"gradients of 10 steps in a row not finite at step 14, .* no checkpoint"):
        run(state, [Divergence(tmp_path)])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("psnrs", "lr", "settled", "said"),
    [
        ([12.0, 20.0, 17.0], None, True, None),
        ([12.0, 20.0, 14.9], 0.1, False, "psnr fell from 20.00 to 14.90 dB: .* too high, try --lr 0.02$"),
        ([3.0], 1.0, False, None),
        ([3.0], 1.0, True, "nothing is learnt: psnr is 3.00 dB, where a single colour gives 9.00; .* try --lr 0.02$"),
        ([8.9, 8.9], None, True, "nothing is learnt: .* try --lr 0.005, or cameras, near and far do not fit"),
        ([None, 9.5], None, True, None),
    ],
)
def test_poor_scores_are_told_with_their_likely_cause(scene, psnrs, lr, settled, said):
    config = resolve(TrainConfig(lr=lr), scene)
    found = why_scores_are_poor([{"psnr": psnr} for psnr in psnrs], config, 9.0, settled=settled)
    assert found is None if said is None else re.search(said, found)
