"""The choice of a call's evaluation path: it is based on measurements, is reported, and has no side effects."""

from __future__ import annotations

import copy
import types
from typing import Any

import pytest
import torch
from convention_harness import uniform
from router_fields import masked_loop
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from voronerf import VoronoiRouter
from voronerf.router import dispatch

CENTRES = torch.rand(6, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


def network() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 4))


@pytest.mark.parametrize("fastest", ["fused", "grouped", "cell by cell"])
def test_the_fastest_is_taken_and_said(monkeypatch: pytest.MonkeyPatch, fastest: str) -> None:
    calls = []
    monkeypatch.setattr(dispatch, "_LOOKS", 1)

    def measured(ways: Any, call: Any, grouping: Any) -> list[float]:
        calls.append([way.name for way in ways])
        return [0.001 if way.name == fastest else 0.004 for way in ways]

    monkeypatch.setattr(dispatch, "measure", measured)
    router, x = VoronoiRouter(network(), CENTRES, coords="first3", fuse=True), uniform((200,))
    for _ in range(3):
        torch.testing.assert_close(router(x), masked_loop(router, router.diagram.locate(x), [x])[0][0])
    others = [f"{name} 4 ms" for name in ("fused", "grouped", "cell by cell") if name != fastest]
    assert router.explain() == f"forward: {fastest}: 1 ms for 200 samples, {', '.join(others)}"
    assert calls == [["fused", "grouped", "cell by cell"]]
    router(uniform((2000,)))  # measured again: over four times as many samples
    router(uniform((2,)))
    with torch.no_grad():
        router(x)
    assert len(calls) == 3


@pytest.mark.parametrize(
    ("fused", "taken"),
    [
        ([17.6, 0.8], "fused"),  # one noisy measurement
        ([17.6, 17.6, 0.8], "fused"),
        ([2.9], "fused"),  # slower, but not by much
        ([17.6, 17.6, 17.6], "grouped"),
    ],
)
def test_a_fused_way_is_left_if_it_is_clearly_slower_again_and_again(
    fused: list[float], taken: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, looks = [0.0], list[float]()

    def measured(ways: Any, call: Any, grouping: Any) -> list[float]:
        looks.append(now[0])
        return [fused[len(looks) - 1], 2.4, 9.0]

    monkeypatch.setattr(dispatch, "measure", measured)
    monkeypatch.setattr(dispatch, "time", types.SimpleNamespace(monotonic=lambda: now[0]))
    router, x = VoronoiRouter(network(), CENTRES, coords="first3", fuse=True), uniform((200,))
    for _ in range(6):
        for _ in range(3):
            router(x)
        y = checkpoint(router, x, use_reentrant=False)
        now[0] += 1.1
        assert len(torch.autograd.grad(y.sum(), list(router.parameters()))) == 4, "the same way again"
    assert len(looks) == len(fused) and looks == sorted(set(looks)), "one at a time"
    assert router.explain().split("\n")[-1].startswith(f"forward: {taken}: "), router.explain()
    assert "measured again" not in router.explain().split("\n")[-1]


def test_what_is_about_as_fast_and_more_promising_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dispatch, "measure", lambda ways, call, grouping: [1.01, 1.0])
    router = VoronoiRouter(network(), CENTRES, coords="first3")
    router(uniform((200,)))
    assert router.explain().startswith("forward: grouped: ")


@pytest.mark.parametrize(
    ("way", "fuse", "taken"),
    [
        ("fused", True, "fused"),
        ("fused", False, "grouped"),
        ("grouped", True, "grouped"),
        ("loop", True, "cell by cell"),
    ],
)
def test_a_way_by_name_is_not_measured(monkeypatch: pytest.MonkeyPatch, way: Any, fuse: bool, taken: str) -> None:
    monkeypatch.setattr(dispatch, "measure", None)
    router, x = VoronoiRouter(network(), CENTRES, coords="first3", fuse=fuse, way=way), uniform((200,))
    torch.testing.assert_close(router(x), masked_loop(router, router.diagram.locate(x), [x])[0][0])
    assert router.explain() == f"forward: {taken}"


def test_a_way_that_is_none() -> None:
    with pytest.raises(ValueError, match="way must be 'fastest', 'fused', 'grouped' or 'loop', got 'quick'"):
        VoronoiRouter(network(), CENTRES, coords="first3", way="quick")  # type: ignore[arg-type]


class Counts(nn.Module):
    """A module that draws random numbers and writes into a buffer."""

    def __init__(self) -> None:
        super().__init__()
        self.net = network()
        self.register_buffer("seen", torch.zeros(()))

    def forward(self, x: Tensor) -> Tensor:
        self.seen += 1
        return self.net(x) + 0 * torch.rand_like(x[:, :1])


@pytest.mark.measures
@pytest.mark.parametrize("requires_grad", [False, True])
def test_measuring_leaves_no_trace(requires_grad: bool) -> None:
    router, x = VoronoiRouter(Counts(), CENTRES, coords="first3"), uniform((200,)).requires_grad_(requires_grad)
    fixed = copy.deepcopy(router)
    fixed.way = "grouped"
    torch.manual_seed(3)
    result = router(x)
    after = torch.get_rng_state()
    text = router.explain()
    assert " ms for 200 samples, " in text and "grouped" in text and "cell by cell" in text
    torch.manual_seed(3)
    torch.testing.assert_close(result, fixed(x))
    if text.startswith("forward: grouped"):
        assert torch.equal(after, torch.get_rng_state()) and router.module.seen == fixed.module.seen == 1
    assert all(parameter.grad is None for parameter in router.parameters()) and x.grad is None


TRIES = [0]


class Half(nn.Module):
    """A module that can run grouped only if no coordinate exceeds 1."""

    def __init__(self) -> None:
        super().__init__()
        self.net = network()

    def forward(self, x: Tensor) -> Tensor:
        TRIES[0] += 1
        if (x.abs() > 1).any():
            return self.net(x.clamp(-1, 1)) * float(len(x) and x[0, 0].detach() > -100)
        return self.net(x)


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
def test_batches_that_cannot_be_grouped_are_tried_by_doubling() -> None:
    router, near = VoronoiRouter(Half(), CENTRES, coords="first3"), uniform((60,)).clamp(-1, 1)
    far = near * 3
    router(near)
    cells = len(router.diagram.locate(far).unique())
    TRIES[0] = 0
    for _ in range(64):
        torch.testing.assert_close(router(far), masked_loop(router, router.diagram.locate(far), [far])[0][0])
    assert 64 * cells < TRIES[0] <= 64 * 2 * cells + 10  # two loops (router, expected) and few others
    for _ in range(80):
        router(near)
    TRIES[0] = 0
    router(near)
    assert TRIES[0] == 1  # grouped again
