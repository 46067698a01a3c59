"""Runs of a few steps on a scene of 16 x 16 pixels, for all tests of training."""

from dataclasses import replace

from helpers import same, trained

from voronerf.app.files import read_json_lines
from voronerf.app.train import Callback, TrainConfig, build, train
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint

SMALL = {"steps": 24, "field": "nerf", "occupancy": False, "cells": (4,), "width": 8, "depth": 2, "rays": 64}
SMALL |= {"samples": (12,), "evaluations": 2, "eval_views": 2}
HIERARCHICAL = {"sampling": "hierarchical", "samples": (12, 6)}


def small(out=None, **settings):
    """24 steps, split into four cells after 12 of them where neither cells nor splits are given."""
    if not {"cells", "split_at"} & settings.keys():
        settings["split_at"] = (0.5,)
    return TrainConfig(out=out, **{**SMALL, **settings})


class Each(Callback):
    """Calls a function after every step."""

    def __init__(self, call):
        self.after_step = call


def steps_of(state, count, *callbacks, **options):
    """Makes so many steps more, and no evaluation or file."""
    last = state.step + count
    train(state, [Each(lambda s: s.stop() if s.step == last else None), *callbacks], **options)
    state.stopped = False
    return state


def started(scene, count, **settings):
    """A state after so many steps, without a run directory."""
    return steps_of(build(small(**settings), scene), count)


def tensors(run):
    return load_checkpoint(checkpoint_path(run)).tensors


def scores(run):
    """Step and PSNR of every evaluation."""
    return [(line["step"], line["psnr"]) for line in read_json_lines(run / "metrics.jsonl")]


def assert_resumes(folder, scene, stop_at, **settings):
    """A run that is stopped and resumed ends bit for bit as one that is not; returns the tensors of its checkpoint."""
    whole = small(folder / "whole", **settings)
    trained(whole, scene)
    part = replace(whole, out=folder / "part")
    summary = trained(part, scene, stop_at=stop_at)
    assert not summary["complete"] and summary["steps"] == stop_at
    trained(part, scene, resume=True)
    found = tensors(folder / "part")
    assert same(tensors(folder / "whole"), found) and scores(folder / "whole") == scores(folder / "part")
    return found
