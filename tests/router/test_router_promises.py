"""Options by which users make promises about a module (`fuse`, `share`, `layout`, `register`), ways and `explain`."""

from __future__ import annotations

import copy
import math
import pickle
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from helpers import same
from ops.foreign_fields import skip_net
from ops.foreign_kinds import ENCODED, PYTORCH, Scales, seen
from ops.foreign_rows import Case, Row
from router_loop import Built, masked_loop, perturb, tensors, uniform
from torch import Tensor, nn

from voronerf import VoronoiRouter
from voronerf.router import register


def centres(k: int = 6) -> Tensor:
    return torch.rand(k, 3, generator=torch.Generator().manual_seed(k)) * 2 - 1


class Rough(nn.Module):
    """Sines of large angles without SIREN's initialisation; float32 rounding makes the results meaningless."""

    def __init__(self) -> None:
        super().__init__()
        self.layers = nn.ModuleList(nn.Linear(3 if i == 0 else 64, 64) for i in range(5))

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers:
            x = torch.sin(30 * layer(x))
        return x


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize("fuse", [False, True])
def test_rounding_is_no_reason_for_a_loop(fuse: bool) -> None:
    router = VoronoiRouter(Rough(), centres(), coords="first3", fuse=fuse)
    router(uniform((200,)))
    assert router.explain() == f"forward: {'fused' if fuse else 'grouped'}"
    exact = copy.deepcopy(router).double()
    x = uniform((200,)).double()
    torch.testing.assert_close(exact(x), exact.cell(0)(x), rtol=1e-4, atol=1e-5)


def test_fused_networks_follow_parameters(generator: torch.Generator) -> None:
    x = torch.rand(60, 15, generator=generator) * 2 - 1
    router = perturb(VoronoiRouter(skip_net(), centres(), coords="first3", fuse=True), generator)
    before = router(x)
    perturb(router, generator)
    assert not torch.allclose(router(x), before)
    same, copied = router(x), pickle.loads(pickle.dumps(router))
    torch.testing.assert_close(copied(x), same)
    assert copied.explain() == "forward: fused"
    doubled = {name: value.double() for name, value in router.state_dict().items() if value.is_floating_point()}
    assert torch.func.functional_call(router, doubled, (x.double(),)).dtype == torch.float64
    with torch.no_grad():
        torch.testing.assert_close(router.eval()(x.reshape(6, 10, 15)).reshape(60, 4), same)


def test_a_module_that_writes_into_its_argument_leaves_that_of_the_call_alone() -> None:
    module = Built(lambda net, x: net.layer(x.view(-1, 3).clamp_(0.1, 0.5) + 1), layer=(3, 2))
    for fuse in (False, True):
        router, x = VoronoiRouter(module, centres(), coords="first3", fuse=fuse), uniform((50,))
        before, expected = x.clone(), router.cell(0)(x.clone())
        torch.testing.assert_close(router(x), expected)
        assert torch.equal(x, before) and router.explain() == f"forward: {'fused' if fuse else 'grouped'}"


def test_shared_parameters_are_one_copy() -> None:
    router = VoronoiRouter(ENCODED.make(), centres(), coords="first3", **ENCODED.options)
    first, cell = "encoder.0.weight", router.cell(1)
    assert router.module.get_parameter("head.bias").shape == (6, 2)
    assert router.module.get_parameter(first).shape == cell.get_parameter(first).shape == (24, 3)
    assert cell.get_parameter(first) is not router.module.get_parameter(first)
    with torch.no_grad():
        cell.get_parameter(first).add_(1)
    with pytest.raises(ValueError, match=f"module's {first} must equal the router's, since all cells share it"):
        router.load_cell(0, cell)


FLAT = {
    "squeezes": lambda net, x, cam: net.fc(torch.cat([x, net.table(cam.squeeze())], -1)),  # as in old code
    "flattens": lambda net, x, cam: net.fc(torch.cat([x, net.table(cam[..., 0])], -1)).reshape(-1, 3),
}


@pytest.mark.parametrize("name", FLAT)
def test_flat_is_for_modules_that_squeeze_or_flatten(name: str) -> None:
    module, x, cam = (
        Built(FLAT[name], table=nn.Embedding(4, 2), fc=(5, 3)),
        uniform((9, 7)),
        torch.randint(4, (9, 7, 1)),
    )
    router = VoronoiRouter(module, centres(), coords="first3", layout="flat")
    torch.testing.assert_close(router(x, cam), module(x, cam).reshape(9, 7, 3))
    with pytest.raises((ValueError, RuntimeError)) as error:
        VoronoiRouter(module, centres(), coords="first3")(x, cam)
    assert "layout='flat'" in str(error.value)


@pytest.mark.filterwarnings("error:VoronoiRouter")
@pytest.mark.parametrize("width", [41, 43, 37])
def test_constants_of_as_many_rows_as_a_trial_has_samples(width):
    waves = Built(lambda net, x: torch.linspace(1, 2, width) * net.fc.bias * torch.sin(net.fc(x)), fc=(3, width))
    router, x = VoronoiRouter(waves, centres(), coords="first3", way="grouped"), uniform((50,))
    torch.testing.assert_close(router(x), router.cell(0)(x))
    assert router.explain() == "forward: grouped"


def test_explain_names_each_method_and_the_step_in_the_way() -> None:
    class Both(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.fc, self.places = nn.Linear(3, 4), nn.Parameter(torch.randn(2, 3))

        def density(self, x: Tensor) -> Tensor:
            return F.softplus(self.fc(x)) * math.pi + self.fc.weight.sum()

        def forward(self, x: Tensor) -> Tensor:
            return torch.cdist(x, self.places)

    alone = VoronoiRouter(Both(), centres(1), coords="first3", methods=["density"])
    alone.density(uniform((40,)))
    assert alone.explain().endswith("density: the module itself: there is one cell")
    router = VoronoiRouter(Both(), centres(), coords="first3", methods=["density"])
    assert router.explain() == "forward: not called yet\ndensity: not called yet"
    router.density(uniform((40,)))
    with pytest.warns(UserWarning, match=r"Both.forward runs cell by cell: torch.functional.cdist takes param") as said:
        router(uniform((40,)))
    forward, density = router.explain().split("\n")
    assert density == "density: grouped"
    assert forward.startswith("forward: cell by cell: torch.functional.cdist takes parameters, and has no rule")
    assert "test_router_promises.py:" in forward and "return torch.cdist(x, self.places)" in forward
    assert forward.partition("cell by cell: ")[2] in str(said[0].message)


def test_explain_says_why_a_method_is_not_fused() -> None:
    class Both(nn.Linear):
        def shade(self, x: Tensor) -> Tensor:
            return super().forward(x) + torch.rand_like(x[:, :1])

    router = VoronoiRouter(Both(3, 2), centres(), coords="first3", methods=["shade"], fuse=True)
    with pytest.warns(UserWarning, match=r"fuse=True needs a network that can be fused, but in Both.shade"):
        router.shade(uniform((40,)))
    for n in (5, 40, 5):
        router(uniform((n,)))
    forward, shade = router.explain().split("\n")
    assert forward == "forward: fused"
    assert shade.startswith("shade: grouped: not fused, since torch.rand_like draws random numbers (test_router_prom")


def test_a_rule_of_ones_own_may_be_wrong(generator: torch.Generator) -> None:
    x, wrongly = torch.rand(50, 7, generator=generator), seen("wrongly")
    with pytest.warns(UserWarning, match="wrongly takes parameters, and has no rule"):
        VoronoiRouter(Scales(wrongly), centres(), coords="first3")(x)
    register(wrongly, lambda run, rows, factor: rows * run.rows_of(factor))
    wrong = perturb(VoronoiRouter(Scales(wrongly), centres(), coords="first3"), generator)
    with pytest.warns(UserWarning, match="gives other results than the loop over cells"):
        torch.testing.assert_close(wrong(x), masked_loop(wrong, x)[0])


@pytest.mark.filterwarnings("ignore:VoronoiRouter")
@pytest.mark.parametrize("row", PYTORCH, ids=lambda row: row.module)
def test_resuming_after_a_split_in_the_order_of_nerf_pytorch(row: Row) -> None:
    """A resumed run loads the optimiser's state and then the network's; here the saved run was split into 4 cells."""
    case = Case(row)
    points, module = case.positions, case.modules[0]

    def made() -> tuple[VoronoiRouter, torch.optim.Optimizer]:
        router = VoronoiRouter(module, torch.zeros(1, 3), **{"coords": "first3", **row.options})
        return router, torch.optim.Adam(router.parameters(), lr=1e-2)

    def step(router: VoronoiRouter, optimizer: torch.optim.Optimizer) -> None:
        optimizer.zero_grad()
        sum(t.square().mean() for t in tensors(case.routed(router))).backward()
        optimizer.step()

    router, optimizer = made()
    step(router, optimizer)
    router.subdivide(4, points=points, weights=torch.ones(len(points)), optimizer=optimizer, min_samples=1)
    step(router, optimizer)
    saved = copy.deepcopy({"network": router.state_dict(), "optimizer": optimizer.state_dict()})
    again, resumed = made()
    resumed.load_state_dict(saved["optimizer"])
    again.load_state_dict(saved["network"])
    for _ in range(2):
        step(router, optimizer)
        step(again, resumed)
    assert again.num_cells == 4
    for a, b in zip(again.parameters(), router.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.parametrize("stored", [5, 6])
def test_a_state_that_does_not_fit_changes_nothing(stored: int) -> None:
    router = VoronoiRouter(nn.Linear(3, 1), centres(), coords="first3")
    before = copy.deepcopy(router.state_dict())
    other = VoronoiRouter(nn.Linear(3, 2), centres(stored), coords="first3").state_dict()
    missing = {name: value for name, value in other.items() if name != "module.weight"}
    for state, actual in ((other, rf"\[{stored}, 2, 3\]"), (missing, "nothing")):
        with pytest.raises(RuntimeError, match=rf"module.weight must have shape \[{stored}, 1, 3\], got {actual}"):
            nn.ModuleDict({"field": router}).load_state_dict({f"field.{name}": value for name, value in state.items()})
        assert same(before, router.state_dict())


@pytest.mark.parametrize("make", [torch.optim.Adam, torch.optim.Adagrad, torch.optim.SGD, torch.optim.LBFGS])
@pytest.mark.parametrize("way", ["load", "split"])
def test_an_optimiser_with_the_state_of_other_cells_says_what_to_write(make: Any, way: str) -> None:
    x, options = uniform((60,)), {"momentum": 0.9} if make is torch.optim.SGD else {}
    router = VoronoiRouter(nn.Linear(3, 2), torch.zeros(1, 3), coords="first3")
    state = VoronoiRouter(nn.Linear(3, 2), centres(), coords="first3").state_dict()
    optimizer = make(router.parameters(), lr=0.1, **options)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = router(x).square().mean()
        loss.backward()
        return loss

    optimizer.step(closure)
    if way == "load":
        router.load_state_dict(state)
    else:
        router.subdivide(3, points=x, weights=torch.ones(60))
    method = "load_state_dict" if way == "load" else "subdivide"
    with pytest.raises(ValueError, match=rf"write router.{method}\(.*optimi"):
        optimizer.step(closure)
    router.load_state_dict(router.state_dict(), optimizer=optimizer)
    before = router.module.weight.detach().clone()
    optimizer.step(closure)
    assert not torch.equal(before, router.module.weight)
    with pytest.raises(ValueError, match="load_state_dict: optimizer must hold the router's parameters"):
        router.load_state_dict(state, optimizer=torch.optim.SGD([nn.Parameter(torch.zeros(2))]))
    number = {**state, 3: torch.ones(2)}
    for wrong, rule in ((number, "have strings as keys, got 3"), ([state], "be a mapping, got list")):
        with pytest.raises(TypeError, match=f"load_state_dict: state_dict must {rule}"):
            router.load_state_dict(wrong)


@pytest.mark.parametrize("width", [37, 74, 1147])
def test_widths_that_are_numbers_of_samples_of_a_trace(width):
    """All widths are multiples of 37, and 1147 is 31 * 37; a trace tries 37 samples first, and 31 samples second."""
    field = nn.Sequential(nn.Linear(3, width), nn.LayerNorm(width), nn.SiLU(), nn.Linear(width, 4))
    router = VoronoiRouter(field, torch.rand(3, 3), coords="first3", fuse=True)
    x = torch.rand(50, 3)
    torch.testing.assert_close(router(x), field(x))
    assert router.explain() == "forward: fused"


def network() -> nn.Module:
    return nn.Sequential(nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 4))


@pytest.mark.parametrize(("way", "taken"), [(None, "fused"), ("grouped", "grouped"), ("loop", "cell by cell")])
def test_the_first_possible_way_is_taken(way: Any, taken: str) -> None:
    options: Any = {} if way is None else {"way": way}
    router, x = VoronoiRouter(network(), centres(), coords="first3", fuse=True, **options), uniform((200,))
    torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    assert router.explain() == f"forward: {taken}"


class Counts(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.net = network()
        self.register_buffer("seen", torch.zeros(()))

    def forward(self, x: Tensor) -> Tensor:
        self.seen += 1
        return self.net(x) + 0 * torch.rand_like(x[:, :1])


@pytest.mark.parametrize("requires_grad", [False, True])
def test_a_first_call_leaves_no_trace(requires_grad: bool) -> None:
    router, x = VoronoiRouter(Counts(), centres(), coords="first3"), uniform((200,)).requires_grad_(requires_grad)
    for count in (1, 2):
        torch.manual_seed(3)
        result, after = router(x), torch.get_rng_state()
        torch.manual_seed(3)
        torch.rand(200, 1)
        assert torch.equal(after, torch.get_rng_state()) and router.module.seen == count
        torch.testing.assert_close(result, masked_loop(router, x)[0])
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
    router, near = VoronoiRouter(Half(), centres(), coords="first3"), uniform((60,)).clamp(-1, 1)
    far = near * 3
    router(near)
    cells = len(router.diagram.locate(far).unique())
    TRIES[0] = 0
    for _ in range(64):
        torch.testing.assert_close(router(far), masked_loop(router, far)[0])
    assert 64 * cells < TRIES[0] <= 64 * 2 * cells + 10  # two loops (router, expected) and few others
    for _ in range(80):
        router(near)
    TRIES[0] = 0
    router(near)
    assert TRIES[0] == 1  # grouped again
