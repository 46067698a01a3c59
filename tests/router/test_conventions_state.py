"""Fields whose forward depends on more than its arguments: what a router learned of one call may not hold for the next.

All have the shape that the fused kernels know, and leave it by an attribute, a buffer, a hook, a mode or a value.
"""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from convention_harness import randomised
from convention_listed import nerf_pytorch, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter
from voronerf.router.fusion import Plan


class Net(nn.Module):
    """Linear layers and ReLU, the plainest of fields, with something beside."""

    def __init__(self, beside: Callable[[Any, Tensor], Tensor] = lambda net, h: h) -> None:
        super().__init__()
        self.a, self.b, self.c = nn.Linear(15, 12), nn.Linear(12, 12), nn.Linear(12, 4)
        self.beside, self.progress = beside, 0.0
        self.register_buffer("mask", torch.ones(12))
        self.kept = torch.ones(12)
        self.settings = SimpleNamespace(shift=0.0, deep={"scale": [1.0]})

    def forward(self, x: Tensor) -> Tensor:
        h = F.relu(self.b(F.relu(self.a(x))))
        return self.c(self.beside(self, h))


def encoded(n: int = 50) -> Tensor:
    return nerf_pytorch.encode(uniform((n,)), 2)


def agree(router: VoronoiRouter, field: nn.Module, x: Tensor | None = None) -> None:
    x = encoded() if x is None else x
    for _ in range(3):  # a network is recognised after some calls
        torch.testing.assert_close(router(x), field(x), rtol=1e-4, atol=1e-5)


@pytest.fixture
def pair() -> Callable[..., tuple[VoronoiRouter, Any]]:
    def make(field: nn.Module) -> tuple[VoronoiRouter, Any]:
        field = randomised(field)
        router = VoronoiRouter(field, torch.rand(5, 3) * 2 - 1, coords="first3")
        agree(router, field)
        return router, field

    return make


def plans_of(router: VoronoiRouter) -> list[Plan]:
    return [plan for plan in router._memory.plans.values() if isinstance(plan, Plan)]


def test_a_number_that_changes(pair: Any) -> None:
    """BARF and Nerfies open the frequencies of their encoding by a number that grows during training."""
    router, field = pair(Net(lambda net, h: h * net.progress if net.progress > 0 else h))
    for progress in (0.25, 0.5, 1.0):
        router.module.progress = field.progress = progress
        agree(router, field)


def test_a_buffer_that_changes(pair: Any) -> None:
    router, field = pair(Net(lambda net, h: h if bool((net.mask == 1).all()) else h * net.mask))
    assert plans_of(router)
    for mask in (torch.rand(12), torch.zeros(12)):
        router.module.mask.copy_(mask)
        field.mask.copy_(mask)
        agree(router, field)
    router.module.mask, field.mask = torch.ones(12) * 3, torch.ones(12) * 3
    agree(router, field)


def test_the_field_here_is_recognised(pair: Any) -> None:
    """Else the tests around would say nothing of plans that outlive what they were made from."""
    router, _ = pair(Net())
    assert plans_of(router)


def scaled_where_kept_is_not_one(net: Any, h: Tensor) -> Tensor:
    mean = float(net.kept.mean())
    return h if mean == 1 else h * mean


def by_settings(net: Any, h: Tensor) -> Tensor:
    scale, shift = net.settings.deep["scale"][0], net.settings.shift
    return h if (scale, shift) == (1.0, 0.0) else h * scale + shift


@pytest.mark.parametrize("numbers", [12, 100])
def test_a_tensor_that_is_no_buffer_changes(pair: Any, numbers: int) -> None:
    field = Net(scaled_where_kept_is_not_one)
    field.kept = torch.ones(numbers)
    router, field = pair(field)
    assert plans_of(router)
    for value in (2.0, -1.0):
        for module in (router.module, field):
            module.kept.fill_(value)
        agree(router, field)
        for module in (router.module, field):
            module.kept = torch.full((numbers,), value + 3)
        agree(router, field)


def test_a_tensor_that_is_made_anew_at_every_step(pair: Any) -> None:
    """The identity of one that is gone goes to another."""
    router, field = pair(Net(scaled_where_kept_is_not_one))
    x = encoded()
    for step in range(40):
        for module in (router.module, field):
            module.kept = torch.tensor([1.0 if step < 9 else step / 9])
        torch.testing.assert_close(router(x), field(x), rtol=1e-4, atol=1e-5)


def test_a_buffer_written_through_data(pair: Any) -> None:
    router, field = pair(Net(lambda net, h: h if bool((net.mask == 1).all()) else h * net.mask))
    assert plans_of(router)
    for value in (3.0, 0.5):
        for module in (router.module, field):
            module.mask.data.fill_(value)
        agree(router, field)


def test_settings_in_an_object(pair: Any) -> None:
    router, field = pair(Net(by_settings))
    assert plans_of(router)
    for scale in (2.0, 0.5):
        for module in (router.module, field):
            module.settings.deep["scale"][0], module.settings.shift = scale, scale + 1
        agree(router, field)


def test_a_layer_of_a_sequence_is_replaced(pair: Any) -> None:
    router, field = pair(nn.Sequential(nn.Linear(15, 8), nn.ReLU(), nn.Linear(8, 3)))
    assert plans_of(router)
    for module in (router.module, field):
        module[1] = nn.Sigmoid()
    agree(router, field)


class Scaled(Net):
    """One with an argument beside the samples."""

    def forward(self, x: Tensor, w: Any, step: int = 0) -> Tensor:
        scale = w["scale"] if isinstance(w, dict) else w
        return super().forward(x) * scale


@pytest.mark.parametrize("kind", ["one number", "shared", "in a dict"])
def test_a_tensor_that_is_the_same_for_all_samples_changes(kind: str) -> None:
    """The time of a dynamic scene, the window of an encoding."""
    field, options = randomised(Scaled()), {} if kind == "one number" else {"shared": ["w"]}
    router = VoronoiRouter(field, torch.rand(5, 3) * 2 - 1, coords="first3", **options)
    x, same = encoded(), torch.rand(4)
    for value in (torch.rand(4), torch.rand(4), same, same, same, same.clone()):
        w = {"one number": value[:1], "shared": value, "in a dict": {"scale": value}}[kind]
        for _ in range(4):
            torch.testing.assert_close(router(x, w), field(x, w), rtol=1e-4, atol=1e-5)
    same.mul_(-1)
    w = {"one number": same[:1], "shared": same, "in a dict": {"scale": same}}[kind]
    torch.testing.assert_close(router(x, w), field(x, w), rtol=1e-4, atol=1e-5)


UNSEEN = {"scale": 1.0}


@pytest.mark.filterwarnings("ignore:.*runs cell by cell")
@pytest.mark.parametrize(
    "beside",
    [
        lambda net, h: h if UNSEEN["scale"] == 1 else h * UNSEEN["scale"],
        # what no plan could follow
        lambda net, h: h if UNSEEN["scale"] == 1 else h * (2.0 if float(h.detach().max()) > -1 else 1.0),
    ],
)
def test_a_change_out_of_sight_is_found_after_a_while(
    pair: Any, monkeypatch: pytest.MonkeyPatch, beside: Callable[[Any, Tensor], Tensor]
) -> None:
    router, field = pair(Net(beside))
    assert plans_of(router)
    monkeypatch.setitem(UNSEEN, "scale", 3.0)
    x = encoded()
    with pytest.warns(UserWarning, match="Net.forward gives other results than when it was recognised"):
        for _ in range(512):
            found = router(x)
    torch.testing.assert_close(found, field(x), rtol=1e-4, atol=1e-5)
    assert not plans_of(router)
    agree(router, field)


def test_a_buffer_with_numbers_that_are_none(pair: Any) -> None:
    field = Net()
    field.mask[3] = float("nan")
    assert plans_of(pair(field)[0])


def test_results_that_a_module_keeps_are_not_kept_by_the_router(pair: Any) -> None:
    def keep(net: Any, h: Tensor) -> Tensor:
        net.settings = SimpleNamespace(last=h.detach(), shift=0.0, deep={})
        return h

    router, _ = pair(Net(keep))
    seen = []
    for _ in range(8):
        router(encoded())
        seen.append(weakref.ref(router.module.settings.last))
    gc.collect()
    assert sum(ref() is not None for ref in seen) <= 1


def test_plans_are_made_after_many_numbers() -> None:
    field = randomised(Scaled())
    router = VoronoiRouter(field, torch.rand(5, 3) * 2 - 1, coords="first3")
    x, w = encoded(), torch.rand(1)
    for step in range(80):
        router(x, w, step=step)
    before = len(plans_of(router))
    for _ in range(4):
        router.eval()(x, w)
    assert len(plans_of(router)) == before + 1


def test_numbers_among_the_arguments_fill_no_memory() -> None:
    field = randomised(Scaled())
    router = VoronoiRouter(field, torch.rand(5, 3) * 2 - 1, coords="first3", shared=["w"])
    x, w = encoded(12).reshape(3, 4, 15), torch.rand(4)
    for step in range(300):
        torch.testing.assert_close(router(x, w, step=step), field(x, w), rtol=1e-4, atol=1e-5)
    memory = router._memory
    assert max(len(memory.plans), len(memory.flat), len(memory.recorded), len(memory.by_cell)) <= 256


def test_a_function_that_is_replaced(pair: Any) -> None:
    router, field = pair(Net())
    for beside in (lambda net, h: F.softplus(h), lambda net, h: h - h.mean(1, keepdim=True)):
        router.module.beside = field.beside = beside
        agree(router, field)


class Counting(Net):
    """One that also counts its calls, and so is in no state twice."""

    calls = 0

    def forward(self, x: Tensor) -> Tensor:
        self.calls += 1
        return super().forward(x)


def test_a_forward_that_counts_its_calls(pair: Any) -> None:
    """Every call of the router is one of the module's, also where no Python of it would have to run."""
    router, field = pair(Counting(lambda net, h: h if net.calls % 2 else torch.sin(h)))
    x = encoded()
    odd, even = (field.c(f(F.relu(field.b(F.relu(field.a(x)))))) for f in (lambda h: h, torch.sin))
    results = [router(x) for _ in range(4)]
    for first, second in (results[:2], results[2:]):
        found = (first, second) if torch.allclose(first, odd, atol=1e-5) else (second, first)
        torch.testing.assert_close(found, (odd, even), rtol=1e-4, atol=1e-5)


def test_training_and_evaluation_modes(pair: Any) -> None:
    router, field = pair(Net(lambda net, h: h * 2 if net.training else h))
    for mode in (False, True, False):
        router.train(mode)
        field.train(mode)
        agree(router, field)
    # dropout: zeroed in one mode only
    router, field = pair(nn.Sequential(nn.Linear(15, 8), nn.ReLU(), nn.Dropout(0.5), nn.Linear(8, 3)).eval())
    router.eval()
    agree(router, field)
    router.train()
    x = encoded()
    assert not torch.equal(router(x), router(x))


@pytest.mark.parametrize(
    "activation",
    [
        lambda h: F.softplus(h, beta=100),
        lambda h: F.softplus(h - 1),
        lambda h: F.softplus(h, 1, 0.1),
        lambda h: F.leaky_relu(h, 0.01),
        lambda h: F.threshold(h, 0.3, 0.0),
        lambda h: h.clamp(min=0, max=1),
        lambda h: h.clamp_min(-0.1),
        lambda h: torch.sin(30 * h),
        lambda h: torch.maximum(h, torch.zeros_like(h)),
        lambda h: F.relu(h) ** 2,
        lambda h: torch.sigmoid(2 * h),
        lambda h: torch.where(h > 0, h, torch.zeros_like(h)) + 1e-3,
        lambda h: F.relu(h).detach() + 0.5 * h,
        lambda h: F.relu(-h),
    ],
)
def test_activations_that_look_like_known_ones(activation: Callable[[Tensor], Tensor], pair: Any) -> None:
    router, field = pair(Net(lambda net, h: activation(h)))
    x = encoded()
    agree(router, field, x)
    first, second = x.clone().requires_grad_(), x.clone().requires_grad_()
    found = torch.autograd.grad(router(first).square().sum(), [first])
    torch.testing.assert_close(found, torch.autograd.grad(field(second).square().sum(), [second]), rtol=1e-3, atol=1e-3)


def test_hooks_of_inner_layers_run(pair: Any) -> None:
    router, field = pair(Net())
    seen: list[tuple[int, ...]] = []
    handles = [module.b.register_forward_hook(lambda m, a, out: 2 * out) for module in (router.module, field)]
    handles.append(router.module.a.register_forward_hook(lambda m, a, out: seen.append(tuple(out.shape))))
    agree(router, field)
    assert seen
    for handle in handles:
        handle.remove()
    agree(router, field)


def test_a_layer_that_is_replaced_or_frozen(pair: Any) -> None:
    router, field = pair(Net())
    router.module.b = nn.Identity()
    field.b = nn.Identity()
    agree(router, field)
    router.module.a.requires_grad_(False)
    router(encoded()).sum().backward()
    assert router.module.a.weight.grad is None and router.module.c.weight.grad is not None
    router.module.a.requires_grad_(True)
    router(encoded()).sum().backward()
    assert router.module.a.weight.grad is not None


def test_parameters_that_are_written(pair: Any) -> None:
    router, field = pair(Net())
    with torch.no_grad():
        for name, parameter in field.named_parameters():
            parameter.mul_(0.5)
            router.module.get_parameter(name).mul_(0.5)
    agree(router, field)
    for name, parameter in field.named_parameters():
        router.module.get_parameter(name).data = parameter.data.expand(5, *parameter.shape).clone()
    agree(router, field)


def test_other_sizes_and_types(pair: Any) -> None:
    """The same module with more samples, other leading shapes, a wider input type, no gradients."""
    router, field = pair(Net())
    for x in (encoded(1), encoded(0), encoded(333), encoded(12).reshape(3, 4, 15), encoded(9).t().contiguous().t()):
        agree(router, field, x)
    with torch.no_grad():
        agree(router, field)
    with torch.inference_mode():
        agree(router, field)
    router, field = router.double(), field.double()
    agree(router, field, encoded().double())


def test_values_that_are_not_finite_stay_with_their_samples(pair: Any) -> None:
    router, field = pair(Net())
    x = encoded()
    x[3, 7], x[11, 9], x[20] = float("nan"), float("inf"), float("nan")
    found, expected = router(x), field(x)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5, equal_nan=True)
    assert found[[0, 4, 12, 19, 21]].isfinite().all()
