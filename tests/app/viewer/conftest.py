"""Fixtures: a run with nested cells on a scene of 24 x 24 pixels, and viewers of this run."""

from __future__ import annotations

import pytest
from helpers import trained

from voronerf.app import open_run
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import TrainConfig

TINY = {"steps": 120, "cells": (3, 2), "split_at": (60, 100), "rays": 256, "samples": (24,), "evaluations": 3}


@pytest.fixture(scope="session")
def scene():
    return builtin_scene(24, train_views=12, test_views=2)


@pytest.fixture(scope="session")
def run(tmp_path_factory, scene):
    folder = tmp_path_factory.mktemp("viewed")
    trained(TrainConfig(out=folder, **TINY), scene)
    return open_run(folder, scene=scene)


@pytest.fixture
def viewer(run, monkeypatch):
    viewers = pytest.importorskip("voronerf.app.viewer", reason="viser is not installed")
    monkeypatch.setattr("voronerf.app.viewer.client.SHARP", 128)
    monkeypatch.setattr("voronerf.app.viewer.client.FULL", 128)
    viewer = viewers.view_run(run, port=0)
    yield viewer
    viewer.close()
