"""The way of a call: the first possible one, which `explain` reports; a first call has no side effects."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from router_loop import masked_loop, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter

CENTRES = torch.rand(6, 3, generator=torch.Generator().manual_seed(1)) * 2 - 1


def network() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 4))


@pytest.mark.parametrize(
    ("way", "fuse", "taken"),
    [
        (None, True, "fused"),
        (None, False, "grouped"),
        ("fused", True, "fused"),
        ("grouped", True, "grouped"),
        ("loop", True, "cell by cell"),
    ],
)
def test_the_first_possible_way_is_taken(way: Any, fuse: bool, taken: str) -> None:
    options: Any = {} if way is None else {"way": way}
    router, x = VoronoiRouter(network(), CENTRES, coords="first3", fuse=fuse, **options), uniform((200,))
    torch.testing.assert_close(router(x), masked_loop(router, router.diagram.locate(x), [x])[0][0])
    assert router.explain() == f"forward: {taken}"


def test_a_way_that_is_none() -> None:
    with pytest.raises(ValueError, match="way must be 'fused', 'grouped' or 'loop', got 'quick'"):
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


@pytest.mark.parametrize("requires_grad", [False, True])
def test_a_first_call_leaves_no_trace(requires_grad: bool) -> None:
    router, x = VoronoiRouter(Counts(), CENTRES, coords="first3"), uniform((200,)).requires_grad_(requires_grad)
    for count in (1, 2):
        torch.manual_seed(3)
        result, after = router(x), torch.get_rng_state()
        torch.manual_seed(3)
        torch.rand(200, 1)
        assert torch.equal(after, torch.get_rng_state()) and router.module.seen == count
        torch.testing.assert_close(result, masked_loop(router, router.diagram.locate(x), [x])[0][0])
    assert router.explain() == "forward: grouped"
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
