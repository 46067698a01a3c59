"""Tests of the timed examples of docs/extend.md."""

from __future__ import annotations

import re
from types import SimpleNamespace

import own_parts
import torch
from step_training import Training

from voronerf.nerf import SplitStrategy


def test_the_distortion_of_the_page_is_that_of_its_source() -> None:
    """Compares the page's `distortion` and `Distortion` with a float64 double sum over the samples of each ray.

    The gradients of the two terms are compared with each other.
    """
    own = own_parts.examples()
    gradients = []
    for term in (own["distortion"], own["Distortion"](0.01)):
        training = Training(cells=2)
        training.loss.terms = (term,)
        batch = training.batches.draw(50, torch.Generator().manual_seed(0))
        output = training.loss(batch, torch.Generator().manual_seed(1), backward=True)
        gradients.append([p.grad for p in training.router.parameters()])
        training.loss.terms = ()
        plain = training.loss(batch, torch.Generator().manual_seed(1))
        samples, weights = output.samples, output.weights.double()
        expected = (weights.square() * samples.deltas).sum() / 3
        for first, last in samples.ray_offsets.unfold(0, 2, 1).tolist():
            away = (samples.depths[first:last, None] - samples.depths[first:last]).abs().double()
            expected += weights[first:last] @ away @ weights[first:last]
        torch.testing.assert_close(
            output.loss - plain.loss.detach(), 0.01 / 50 * expected.float(), rtol=1e-3, atol=1e-7
        )
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-7)


def test_what_is_timed_is_what_the_table_says() -> None:
    """Checks that the parts named in the table run hooks in Python, except `Twice`, which is marked as replayed."""
    own, python = own_parts.examples(), []
    for name, change in own_parts.WAYS.items():
        training = Training(cells=2)
        state = SimpleNamespace(ray_loss=training.loss, sampler=training.sampler, training_step=training.step)
        state.strategy = training.step.strategy = SplitStrategy({"field": training.router}, [])
        change(state, own)
        training.train(4)
        said = re.findall(r"in Python: ([\w.]+)", training.step.explain())
        python += [f"{name}: {each}" for each in said]
    assert python == [
        "a split strategy (`WhenFlat`): WhenFlat.step_post_backward",
        "a sampler (`Annealed`): Annealed.sample",
        "a term of one line (`clear`): clear",
        "a term of eight lines (`distortion`): distortion",
        "the same with its gradient (`Distortion`): Distortion.add",
    ]
