"""Trainings that go wrong: noticed, told, and led back where that helps."""

import re
from dataclasses import replace

import pytest
import torch
from helpers import same
from tiny_runs import small, stopping, tensors

from voronerf.app.train.config import TrainConfig
from voronerf.app.train.divergence import why_scores_are_poor
from voronerf.app.train.progress import TrainingError
from voronerf.app.train.trainer import Trainer


def weights(trainer):
    return [parameter.detach().clone() for parameter in trainer.router.parameters()]


@pytest.mark.parametrize("value", [float("inf"), float("nan"), 1e19])
@pytest.mark.parametrize("field", ["nerf", "hashgrid"])
def test_a_step_with_such_a_gradient_is_skipped_and_counted(tmp_path, scene, field, value):
    trainer = Trainer(small(tmp_path, field=field, cells=()), scene)
    trainer.advance(trainer.seconds + 1e-9)  # a step
    bias = next(p for name, p in trainer.router.named_parameters() if name.endswith("bias"))
    hook = bias.register_hook(lambda gradient: gradient + value)
    before, state = weights(trainer), trainer.optimizer.state[bias]["exp_avg_sq"].clone()
    trainer.advance(trainer.seconds + 1e-9)
    assert same(before, weights(trainer)) and same([state], [trainer.optimizer.state[bias]["exp_avg_sq"]])
    hook.remove()
    summary = trainer.run()
    assert summary["complete"] and summary["skipped_steps"] == 1 and not same(before, weights(trainer))


@pytest.mark.parametrize("harm", ["weights", "moments"])
def test_a_diverged_run_goes_back_once_with_half_the_rate(tmp_path, scene, harm):
    lines = []
    trainer = stopping(small(tmp_path, steps=60), scene, 20, on_event=lines.append)
    trainer.advance()
    trainer.save()
    trainer.stopped = False
    harmed = {25, 45}

    def on_step(progress):
        if progress.step in harmed:
            harmed.remove(progress.step)
            parameter = next(iter(trainer.router.parameters()))
            with torch.no_grad():
                (parameter if harm == "weights" else trainer.optimizer.state[parameter]["exp_avg_sq"]).fill_(torch.inf)
            trainer.saved_at = -1000.0  # a checkpoint is due

    trainer.on_step = on_step
    rate = trainer.learning_rate()
    if harm == "weights":
        trainer.config = replace(trainer.config, checkpoint_every=1e9)
    with pytest.raises(TrainingError, match=r"not finite at step \d+, try a smaller --lr; with half the rate again"):
        trainer.run()
    assert not harmed and sum("back to step 20, with half the learning rate" in line for line in lines) == 1
    kept = tensors(tmp_path)
    assert all(tensor.isfinite().all() for tensor in kept.values() if tensor.is_floating_point())
    resumed = Trainer(replace(trainer.config, resume=True), scene)
    assert resumed.step == 20 or resumed.rate_factor == 0.5
    resumed.step = 20
    assert resumed.learning_rate() in (rate, rate / 2)


def test_a_run_that_diverges_before_its_first_checkpoint_ends(tmp_path, scene):
    trainer = stopping(small(tmp_path, cells=(), evaluations=1), scene, 4)
    trainer.advance()
    trainer.stopped = False
    with torch.no_grad():
        next(iter(trainer.router.parameters())).fill_(torch.nan)
    with pytest.raises(TrainingError, match=r"gradients of 10 steps in a row not finite at step 14, .* no checkpoint"):
        trainer.run()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("scores", "lr", "settled", "said"),
    [
        ([12.0, 20.0, 17.0], None, True, None),
        ([12.0, 20.0, 14.9], 0.1, False, "psnr fell from 20.00 to 14.90 dB: .* too high, try --lr 0.02$"),
        ([3.0], 1.0, False, None),
        ([3.0], 1.0, True, "nothing is learnt: psnr is 3.00 dB, where a single colour gives 9.00; .* try --lr 0.02$"),
        ([8.9, 8.9], None, True, "nothing is learnt: .* try --lr 0.005, or cameras, near and far do not fit"),
        ([None, 9.5], None, True, None),
    ],
)
def test_poor_scores_are_told_with_their_likely_cause(scores, lr, settled, said):
    found = why_scores_are_poor([{"psnr": psnr} for psnr in scores], TrainConfig(lr=lr), 9.0, settled=settled)
    assert found is None if said is None else re.search(said, found)


def test_too_high_a_rate_is_told(tmp_path, scene):
    lines = []
    config = small(tmp_path, field="hashgrid", width=None, depth=None, lr=1.0, steps=100, cells=(), evaluations=1)
    Trainer(config, scene, on_event=lines.append).run()
    assert "nothing is learnt" in lines[-1] and "try --lr 0.02" in lines[-1]
