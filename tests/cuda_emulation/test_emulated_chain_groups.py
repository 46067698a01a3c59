"""The chained network with products of four warps: its plan, and the tests of the chain once more."""

from __future__ import annotations

import pytest
import torch
from emulated import emulated
from emulated_networks import BRANCHED, KIB, NARROW, SKIPS, case, check, run
from test_emulated_chain import (
    HALVES,
    chain,
    nerf,
    plain,
    right,
    test_gaussians,
    test_numbers_that_are_none_stay_in_their_rows,
    test_tensors_that_are_not_aligned,
    test_weights_that_pass_through,
    test_widths,
)
from test_emulated_chain import numbers as table

from voronerf.fields import NeRF
from voronerf.layers import MLP
from voronerf.native import grouped_mlp as _native_mlp

WGMMA = _native_mlp.WAYS.index("wgmma")
RULE = "wgmma must be asked for with compute capability 9.0 and kernels compiled for sm_90a"
__all__ = [
    "test_gaussians",
    "test_numbers_that_are_none_stay_in_their_rows",
    "test_tensors_that_are_not_aligned",
    "test_weights_that_pass_through",
    "test_widths",
]


@pytest.fixture(autouse=True)
def _asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_native_mlp, "_WAY", WGMMA)


def test_the_tests_above_are_of_these_products() -> None:
    with emulated() as own:
        plan = own.grouped_mlp_plan(table(SKIPS), _native_mlp._OPERANDS.index("bfloat16"), 1000, 2, False, WGMMA)
    assert plan["groups"] and _native_mlp.WAYS[plan["way"]] == "chain"


@pytest.mark.parametrize("precision", HALVES)
@pytest.mark.parametrize("shared", [227, 120])
def test_skips(precision: str, shared: int) -> None:
    """Values in registers and in shared memory, resident weights and such that pass through."""
    with emulated(seed=shared, shared_bytes=shared * KIB):
        right(SKIPS, [37, 290], 3, precision)


@pytest.mark.parametrize("precision", HALVES)
def test_branched_network(precision: str) -> None:
    """Cells of fewer rows than four warps have, and gradients, which go as without."""
    with emulated(seed=1):
        check(BRANCHED, [129, 0, 1, 70], 3, precision)


@pytest.mark.parametrize("layers", [NeRF(width=64).layers, NARROW], ids=["nerf64", "narrow"])
def test_networks_of_the_benchmarks(layers: MLP) -> None:
    with emulated():
        right(layers, [300, 2], 3, "bfloat16")


def test_as_the_warps_themselves() -> None:
    """The same products in the same order: not a bit differs in the emulation."""
    given = case(plain(64, 3), [200, 0, 31], 3, torch.bfloat16)
    results = []
    for asked in ("wgmma", "chain"):
        with emulated(), _native_mlp.taking(asked):
            results.append(run(given, plain(64, 3), torch.bfloat16, "native")[0])
    assert torch.equal(*results)


def test_plans_have_whole_groups() -> None:
    for layers in (plain(64, 4), plain(32, 3), NeRF(width=64).layers, nerf(128, 8), SKIPS):
        for shared in (227, 99, 64):
            alone, together = (chain(layers, shared_bytes=shared * KIB, groups=groups) for groups in (False, True))
            if isinstance(together, str):
                assert (
                    together == "two pieces of weights, and what four warps keep, must fit the shared memory of a block"
                )
                continue
            assert together["warps"] % 4 == 0 and together["groups"] and not alone["groups"]
            # Descriptors count in 16 bytes.
            assert all(layer["piece"] % 16 == 0 for layer in together["layers"]) and together["slot"] % 16 == 0
            if alone["warps"] >= 4:
                assert {**alone, "groups": True} == together


def test_only_on_hopper_and_only_for_those_who_ask() -> None:
    assert not chain(plain(64, 4))["groups"]
    for capability in (75, 80, 89, 100, 103, 120):
        assert chain(plain(64, 4), precision="float16", groups=True, capability=capability) == RULE
    assert chain(plain(64, 4), groups=True, compiled=False) == RULE
    with emulated(capability=100), pytest.raises(ValueError, match=f"grouped_mlp: {RULE} on CUDA"):
        run(case(plain(64, 2), [4], 3, torch.bfloat16), plain(64, 2), torch.bfloat16, "native")
