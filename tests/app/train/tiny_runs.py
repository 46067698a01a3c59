"""Runs of a few steps on a scene of 16 x 16 pixels, for all tests of training."""

from dataclasses import replace

from helpers import same

from voronerf.app.files import read_json_lines
from voronerf.app.train.checkpoint import checkpoint_path, load_checkpoint
from voronerf.app.train.config import TrainConfig
from voronerf.app.train.trainer import Trainer

SMALL = {
    "steps": 24,
    "field": "nerf",
    "occupancy": False,
    "cells": (4,),
    "width": 8,
    "depth": 2,
    "rays": 64,
    "samples": 12,
    "fine_samples": 6,
    "reservoir": 400,
    "reservoir_batches": 10,
    "min_cell_samples": 8,
    "evaluations": 2,
    "eval_views": 2,
    "final_views": 2,
}


def small(out, **settings):
    """24 steps, split into four cells after 12 of them where neither cells nor splits are given."""
    if not any(name == "cells" or name.startswith("split_at") for name in settings):
        settings["split_at"] = (0.5,)
    return TrainConfig(out=out, **{**SMALL, **settings})


def stopping(config, scene, step, **options):
    """A trainer that stops after a step, as after Ctrl-C."""
    trainer = Trainer(config, scene, **options)
    trainer.on_step = lambda progress: trainer.request_stop() if progress.step == step else None
    return trainer


def tensors(run):
    return load_checkpoint(checkpoint_path(run)).tensors


def scores(run):
    """Step and PSNR of every evaluation."""
    return [(line["step"], line["psnr"]) for line in read_json_lines(run / "metrics.jsonl")]


def assert_resumes(folder, scene, stop_at, **settings):
    """A run that is stopped and resumed ends bit for bit as one that is not; returns the tensors of its checkpoint."""
    whole = small(folder / "whole", **settings)
    Trainer(whole, scene).run()
    part = replace(whole, out=folder / "part")
    summary = stopping(part, scene, stop_at).run()
    assert not summary["complete"] and summary["steps"] == stop_at
    Trainer(replace(part, resume=True), scene).run()
    found = tensors(folder / "part")
    assert same(tensors(folder / "whole"), found) and scores(folder / "whole") == scores(folder / "part")
    return found
