"""Fixtures of the web page's tests."""

from __future__ import annotations

import functools

import pytest
from random_runs import random_run


@pytest.fixture(scope="session")
def runs():
    """A function that returns the random run of a kind; it makes each run only once."""
    return functools.cache(random_run)
