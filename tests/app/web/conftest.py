"""Runs that a page draws."""

from __future__ import annotations

import pytest
from random_runs import random_run

from voronerf.app.run import Run


@pytest.fixture(scope="session")
def runs():
    """Makes a run of a kind, once."""
    made: dict[str, Run] = {}

    def run(kind: str) -> Run:
        if kind not in made:
            made[kind] = random_run(kind)
        return made[kind]

    return run
