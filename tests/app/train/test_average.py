"""Averaged weights: what evaluations and pictures use, through splits and resumed runs."""

from dataclasses import replace

import pytest
import torch
from helpers import same
from tiny_runs import assert_resumes, small, stopping, tensors

from voronerf import open_run
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint, save_checkpoint
from voronerf.app.train.trainer import Trainer


def weights(trainer):
    return [p.detach().clone() for router in trainer.routers.values() for p in router.parameters()]


def averages(trainer):
    with trainer.averaged():
        return weights(trainer)


@pytest.mark.parametrize("decay", [0.5, 0.98])
def test_averages_are_exponential_over_a_growing_window(tmp_path, scene, decay):
    trainer = Trainer(small(tmp_path, steps=130, cells=(), average=decay, evaluations=1), scene)
    expected, passed = None, []

    def follow(progress):
        nonlocal expected
        done, now = progress.step - 1, weights(trainer)
        if done % 8 == 0:
            window = min(1 / (1 - decay), max(1, done / 30))
            new = 1 - (1 - 1 / window) ** 8
            expected = now if expected is None else [a + (b - a) * new for a, b in zip(expected, now)]
        if progress.step % 10 == 0:
            torch.testing.assert_close(averages(trainer), expected, rtol=1e-4, atol=1e-6)
            assert same(dict(enumerate(weights(trainer))), dict(enumerate(now)))
            passed.append(not same(dict(enumerate(expected)), dict(enumerate(now))))

    trainer.on_step = follow
    trainer.advance()
    assert len(passed) == 13 and any(passed)


def test_training_is_the_same_with_and_without(tmp_path, scene):
    for name, decay in (("with", 0.98), ("without", 0.0)):
        Trainer(small(tmp_path / name, average=decay), scene).run()
    with_, without = tensors(tmp_path / "with"), tensors(tmp_path / "without")
    # Errors are those of what pictures show, so of the averages.
    assert not torch.equal(with_.pop("errors.usual"), without.pop("errors.usual"))
    assert same({name: with_[name] for name in without}, without)
    assert set(with_) - set(without) and all(name.endswith(".average") for name in set(with_) - set(without))


@pytest.mark.parametrize("init", ["inherit", "random"])
def test_children_have_the_average_of_their_parent(tmp_path, scene, init):
    trainer = Trainer(small(tmp_path, steps=200, split_at=(0.9,), init=init), scene)
    stop = 170
    trainer.on_step = lambda progress: trainer.request_stop() if progress.step == stop else None
    trainer.advance()
    before, own = averages(trainer), weights(trainer)
    assert any(not torch.equal(a, b) for a, b in zip(before, own))
    trainer.split()
    children = weights(trainer) if init == "random" else [parent.expand(4, *parent.shape[1:]) for parent in before]
    assert all(torch.equal(a, b) for a, b in zip(averages(trainer), children, strict=True))


def test_resumed_runs_have_the_same_averages(tmp_path, scene):
    found = assert_resumes(tmp_path, scene, 90, steps=100, split_at=(0.7,), sampling="hierarchical")
    assert any(name.endswith(".average") for name in found)
    run = open_run(tmp_path / "part", scene=scene)
    assert any(not torch.equal(p, found[f"router.{name}"]) for name, p in run.router.named_parameters())


def test_a_run_from_before_averages_goes_on_with_them(tmp_path, scene):
    config = small(tmp_path, average=0.0)
    stopping(config, scene, 14).run()
    path = checkpoint_path(tmp_path)
    checkpoint = load_checkpoint(path)
    del checkpoint.values["config"]["average"]
    save_checkpoint(path, checkpoint)
    assert open_run(tmp_path, scene=scene).evaluate(views=1)["psnr"] > 0
    trainer = Trainer(replace(config, average=0.98, resume=True), scene)
    assert same(dict(enumerate(averages(trainer))), dict(enumerate(weights(trainer))))
    trainer.run()
    assert any(name.endswith(".average") for name in tensors(tmp_path))
