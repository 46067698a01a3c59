"""Draws valid arguments of ``cell_sort`` for the tests, and lists invalid arguments."""

from __future__ import annotations

from cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    k = draw.among("k", 6, 1, 2, 17, 300, 5000)
    return {"cells": draw.integers(0, k, n), "k": k}


CASE = Case(
    _make,
    refused={
        "k must be an integer, got str": {"k": "x"},
        "k must be at least 1, got 0": {"k": 0},
        "k must be at most 134217728, got 2147483647": {"k": 2**31 - 1},
    },
    device_rows=260,
    hostile="indices",
)
