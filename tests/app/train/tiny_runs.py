"""Defines runs of a few steps on a scene of 16 x 16 pixels, for the training tests."""

from dataclasses import replace

from helpers import same, trained

from voronerf.app.files import read_json_lines
from voronerf.app.train import Callback, TrainConfig, build, train
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint

SMALL = {"steps": 24, "field": "nerf", "occupancy": False, "cells": (4,), "width": 8, "depth": 2, "rays": 64}
SMALL |= {"samples": (12,), "evaluations": 2, "eval_views": 2}
HIERARCHICAL = {"sampling": "hierarchical", "samples": (12, 6)}


def small(out=None, **settings):
    """Returns settings for 24 steps; by default the cell is split into four after 12 steps."""
    if not {"cells", "split_at"} & settings.keys():
        settings["split_at"] = (0.5,)
    return TrainConfig(out=out, **{**SMALL, **settings})


class Each(Callback):
    """A callback that calls a function after every step."""

    def __init__(self, call):
        self.after_step = call


def steps_of(state, count, *callbacks, **options):
    """Trains `count` more steps without evaluations and files; returns the state."""
    last = state.step + count
    train(state, [Each(lambda s: s.stop() if s.step == last else None), *callbacks], **options)
    state.stopped = False
    return state


def started(scene, count, **settings):
    """Returns a new training's state after `count` steps, without a run folder."""
    return steps_of(build(small(**settings), scene), count)


def tensors(run):
    return load_checkpoint(checkpoint_path(run)).tensors


def scores(run):
    """Returns (step, PSNR) of every evaluation of a run."""
    return [(line["step"], line["psnr"]) for line in read_json_lines(run / "metrics.jsonl")]


def assert_resumes(folder, scene, stop_at, **settings):
    """Fails unless a stopped and resumed run equals an unstopped one bit for bit; returns its checkpoint's tensors."""
    whole = small(folder / "whole", **settings)
    trained(whole, scene)
    part = replace(whole, out=folder / "part")
    summary = trained(part, scene, stop_at=stop_at)
    assert not summary["complete"] and summary["steps"] == stop_at
    trained(part, scene, resume=True)
    resumed = tensors(folder / "part")
    assert same(tensors(folder / "whole"), resumed) and scores(folder / "whole") == scores(folder / "part")
    return resumed
