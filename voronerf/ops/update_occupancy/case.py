"""The case of ``update_occupancy``."""

from __future__ import annotations

from voronerf.ops.cases import Arguments, Case, Draw


def _make(draw: Draw, n: int) -> Arguments:
    density = draw.uniform(*(draw.number("side", side, 1, 9) for side in (2, 3, 4)))
    call = {"density": density, "cells": draw.integers(0, density.numel(), n), "values": draw.uniform(n)}
    return {**call, "decay": 0.5, "threshold": draw.among("threshold", 0.4, 0.0, 0.9)}


CASE = Case(
    _make,
    refused={
        "threshold must be a number, got str": {"threshold": "x"},
        "threshold must be at most 1.8e+308, got an integer of more digits": {"threshold": 10**400},
    },
)
