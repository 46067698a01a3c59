"""Fixtures of the web page's tests."""

from __future__ import annotations

import pytest
from random_runs import random_run

from voronerf.app.run import Run


@pytest.fixture(scope="session")
def runs():
    """A function that returns the random run of a kind; it makes each run only once."""
    cache: dict[str, Run] = {}

    def run(kind: str) -> Run:
        if kind not in cache:
            cache[kind] = random_run(kind)
        return cache[kind]

    return run
