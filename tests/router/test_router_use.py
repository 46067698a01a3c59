"""Tests of VoronoiRouter in a training loop: arguments, methods, optimisers, copies, wrappers, errors."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.distributed
from helpers import refuses
from ops.foreign_fields import Heads, LearnedSine, skip_net
from ops.foreign_kinds import CodePerRay
from router_loop import masked_loop, perturb, tensors
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from voronerf import NeRF, VoronoiDiagram
from voronerf.ops._core.tolerances import FLOOR
from voronerf.router import VoronoiRouter
from voronerf.router.optimizers import MOMENTS, steady_part


def uniform(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.rand(shape, generator=generator) * 2 - 1


def router_of(module: nn.Module, generator: torch.Generator, k: int = 5, **options: Any) -> VoronoiRouter:
    options = {"coords": "first3", **options}
    return perturb(VoronoiRouter(module, uniform(generator, k, 3), **options), generator)


def test_where_positions_are(generator: torch.Generator) -> None:
    x = uniform(generator, 30, 15)
    first = router_of(skip_net(), generator)
    for coords, shift in (("first3", 0), (slice(3, 6), 3), (lambda x: x[:, 6:9], 6)):
        router = VoronoiRouter(skip_net(), first.diagram, coords=coords)
        router.load_state_dict(first.state_dict())
        cells = router.diagram.locate(x[:, shift : shift + 3])
        torch.testing.assert_close(router(x), masked_loop(router, x, cells=cells)[0])
    elsewhere = uniform(generator, 30, 3)
    expected = masked_loop(first, x, cells=first.diagram.locate(elsewhere))
    torch.testing.assert_close([first(x, coords=elsewhere)], expected)


def test_per_ray_has_to_be_said_where_shapes_do_not_tell(generator: torch.Generator) -> None:
    for rays, samples in ((6, 5), (4, 4)):
        x, d, code, time = (uniform(generator, *s) for s in ((rays, samples, 3), (rays, 1, 3), (rays, 5), (rays,)))
        router = router_of(CodePerRay(), generator)
        with pytest.raises(ValueError, match=r"per_ray must say what code is.*per_ray=\['code'\]"):
            router(x, d, code=code, time=time)
        said = VoronoiRouter(CodePerRay(), router.diagram, coords="first3", per_ray=["code", "time"])
        said.load_state_dict(router.state_dict())
        longer = torch.cat([x, x], 1)
        expected = router(longer, d, code=code, time=time)[:, :samples]
        assert router.explain() == "forward: grouped"
        torch.testing.assert_close(said(x, d, code=code, time=time), expected)


@pytest.mark.parametrize("fuse", [False, True])
def test_methods_share_an_assignment(fuse: bool, generator: torch.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    options: dict[str, Any] = {"methods": ["density"], "assignment": "stochastic", "temperature": 0.5}
    router, drawn, sample_cell = router_of(Heads(), generator, fuse=fuse, **options), [], VoronoiDiagram.sample_cell
    monkeypatch.setattr(
        VoronoiDiagram, "sample_cell", lambda *args, **kwargs: drawn.append(sample_cell(*args, **kwargs)) or drawn[-1]
    )
    x, d = uniform(generator, 40, 3), uniform(generator, 40, 3)
    for count in (1, 2, 3):
        _, sigma = router(x, d)
        torch.testing.assert_close(router.density(x)["sigma"], sigma)
        assert len(drawn) == count
        torch.testing.assert_close(sigma, masked_loop(router, x, d, cells=drawn[-1])[1])
    router.density(x)  # a second ``density`` call with this batch draws new cells
    x.add_(1)
    router(x, d)
    assert len(drawn) == 5


OPTIMIZERS: dict[str, Callable[[Any], torch.optim.Optimizer]] = {
    "Adam": lambda groups: torch.optim.Adam(groups, lr=1e-3, amsgrad=True),
    "AdamW": lambda groups: torch.optim.AdamW(groups, lr=1e-3),
    "RAdam": lambda groups: torch.optim.RAdam(groups, lr=1e-3),
    "SGD": lambda groups: torch.optim.SGD(groups, lr=1e-3, momentum=0.9),
    "Adagrad": lambda groups: torch.optim.Adagrad(groups, lr=1e-3),
}


@pytest.mark.parametrize("name", OPTIMIZERS)
def test_children_step_as_their_parent_would(generator: torch.Generator, name: str) -> None:
    """After a split that moves no sample, a step equals the step without the split if moments are divided."""
    x = uniform(generator, 200, 3)
    router = router_of(LearnedSine(), generator, k=2)
    router.module.b.requires_grad_(False)
    frozen = router.module.b.weight.detach().clone()
    trained = [p for p in router.parameters() if p.requires_grad]
    optimizer = OPTIMIZERS[name]([{"params": trained[:2], "weight_decay": 0.1}, {"params": trained[2:]}])
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.5)

    def step(router: VoronoiRouter, optimizer: torch.optim.Optimizer) -> None:
        optimizer.zero_grad()
        router(x).square().mean().backward()
        optimizer.step()

    for _ in range(3):
        step(router, optimizer)
    plain = copy.deepcopy(router)
    other = OPTIMIZERS[name]([{"params": [p]} for p in plain.parameters() if p.requires_grad])
    for a, b in zip(trained, (g["params"][0] for g in other.param_groups), strict=True):
        other.state[b] = copy.deepcopy(optimizer.state[a])
        steady = steady_part(other.state[b], optimizer.param_groups[0])
        for key in MOMENTS & other.state[b].keys():
            other.state[b][key][0] /= 2
            if steady is not None and key.endswith("exp_avg_sq"):
                other.state[b][key][0] *= 1 - steady[0] / 2
    # The new centre is far away: its cell has no samples, and the other cells keep their samples.
    finer, parents = router.diagram.refine({0: torch.cat([router.diagram.centres[:1], torch.full((1, 3), 90.0)])})
    router.subdivide(finer, parents, optimizer=optimizer)
    schedule.step()
    assert [group["lr"] for group in optimizer.param_groups] == [5e-4, 5e-4]
    assert optimizer.param_groups[0]["weight_decay"] == 0.1
    for group, twin in zip(optimizer.param_groups, (0, 2), strict=True):
        group["lr"], group["weight_decay"] = 1e-3, other.param_groups[twin]["weight_decay"]
    step(router, optimizer)
    step(plain, other)
    for (key, a), b in zip(router.module.named_parameters(), plain.module.parameters(), strict=True):
        torch.testing.assert_close(a[[0, 2]], b, msg=lambda text, key=key: key + text)
    assert torch.equal(router.module.b.weight[0], frozen[0]) and not router.module.b.weight.requires_grad


def test_other_optimisers_begin_anew_and_say_so(generator: torch.Generator) -> None:
    x = uniform(generator, 60, 3)
    router = router_of(LearnedSine(), generator, k=1)
    optimizer = torch.optim.LBFGS(router.parameters(), max_iter=2)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = router(x).square().mean()
        loss.backward()
        return loss

    optimizer.step(closure)
    with pytest.warns(UserWarning, match="state of LBFGS cannot be inherited"):
        router.subdivide(VoronoiDiagram(uniform(generator, 3, 3)), optimizer=optimizer)
    before = [p.detach().clone() for p in router.parameters()]
    optimizer.step(closure)
    assert any(not torch.equal(a, b) for a, b in zip(before, router.parameters(), strict=True))


def stepped(generator: torch.Generator, k: int, **options: Any) -> tuple[VoronoiRouter, torch.optim.Optimizer]:
    """Returns a router and its Adam after a step."""
    router = router_of(nn.Linear(3, 2), generator, k=k)
    optimizer = torch.optim.Adam(router.parameters(), **options)
    router(uniform(generator, 90, 3)).square().sum().backward()
    optimizer.step()
    return router, optimizer


def test_moments_that_are_soon_forgotten_stay_whole(generator: torch.Generator) -> None:
    router, optimizer = stepped(generator, 1, betas=(0.9, 0.99))
    before = [state["exp_avg_sq"].clone() for state in optimizer.state.values()]
    router.subdivide(3, points=uniform(generator, 90, 3), optimizer=optimizer)
    for old, state in zip(before, optimizer.state.values(), strict=True):
        assert torch.equal(state["exp_avg_sq"], old.expand(3, *old.shape[1:]))


def test_factored_squares_are_reset(generator: torch.Generator) -> None:
    """Optimisers such as Adam-mini keep one mean square for a block of a parameter."""
    router, optimizer = stepped(generator, 2)
    for state in optimizer.state.values():
        state["exp_avg_sq"] = state["exp_avg_sq"].flatten(1).mean(1)
    with pytest.warns(UserWarning, match="state of Adam cannot be inherited"):
        router.subdivide(3, points=uniform(generator, 90, 3), optimizer=optimizer)
    assert not optimizer.state


def test_subdivide_by_a_number_of_children(generator: torch.Generator) -> None:
    router = router_of(LearnedSine(), generator, k=1)
    x = uniform(generator, 90, 3)
    before = router(x)
    parents = router.subdivide(4, points=x, weights=torch.rand(90, generator=generator))
    assert router.num_cells == 4 and parents.tolist() == [0] * 4
    parents = router.subdivide(2, points=x, weights=torch.rand(90, generator=generator), cells=[1])
    assert parents.tolist() == [0, 1, 1, 2, 3] and router.diagram.depth == 2
    torch.testing.assert_close(router(x), before)
    refuses("a number of children needs points, and no parents", router.subdivide, 4)
    other = router_of(LearnedSine(), generator, k=1)
    other.subdivide(4, points=x)  # all points have equal weight
    assert other.num_cells == 4
    with pytest.raises(TypeError, match="must be a VoronoiDiagram or a number of children, got float"):
        router.subdivide(2.0)  # type: ignore[arg-type]
    refuses("points must come with a number of children", router.subdivide, router.diagram, points=x)
    stranger = torch.optim.SGD([nn.Parameter(torch.zeros(1))])
    refuses("optimizer must hold the router's parameters", router.subdivide, router.diagram, optimizer=stranger)


@pytest.mark.parametrize("mean", [0.0, 0.5, 1.0])
def test_children_share_the_moments_of_their_parent(generator: torch.Generator, mean: float) -> None:
    """A third of the samples has a third of the mean gradient and of the variance, and a ninth of the mean's square."""
    router, optimizer = stepped(generator, 2)
    for state in optimizer.state.values():
        state["exp_avg"] *= mean  # relative to the root mean square
    before = [{key: value.clone() for key, value in state.items()} for state in optimizer.state.values()]
    router.subdivide(3, points=uniform(generator, 90, 3), cells=[1], optimizer=optimizer)
    for old, state in zip(before, optimizer.state.values(), strict=True):
        for key, part in {"exp_avg": 1 / 3, "exp_avg_sq": mean**2 / 9 + (1 - mean**2) / 3}.items():
            expected = torch.stack([old[key][0], *[old[key][1] * part] * 3])
            torch.testing.assert_close(state[key], expected, rtol=1e-4, atol=0)
        assert state["step"] == old["step"]


@pytest.mark.parametrize(("make", "dtype"), [(skip_net, torch.bfloat16), (LearnedSine, torch.float16)])
def test_half_precision(generator: torch.Generator, dtype: torch.dtype, make: type[nn.Module]) -> None:
    router = router_of(make(), generator)
    x = uniform(generator, 64, 15 if make is skip_net else 3).to(dtype)
    exact = router(x.float())
    router = router.to(dtype)
    assert router.diagram.centres.dtype == torch.float32
    for _ in range(3):
        actual = router(x)
        assert actual.dtype == dtype
        torch.testing.assert_close(actual.float(), exact, rtol=0.1, atol=0.05)


def test_a_network_in_half_precision_between_floats_is_fused(generator: torch.Generator) -> None:
    class Between(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Sequential(nn.Linear(3, 32), nn.ReLU(), nn.Linear(32, 4)).bfloat16()

        def forward(self, x: Tensor) -> Tensor:
            return self.net(x.bfloat16()).float()

    router = VoronoiRouter(Between(), uniform(generator, 5, 3), coords="first3", fuse=True)
    x = uniform(generator, 120, 3)
    actual, (expected, *_) = router(x), masked_loop(router, x)
    assert actual.dtype == torch.float32 and router.explain().startswith("forward: fused")
    torch.testing.assert_close(actual, expected, rtol=0.02, atol=0.02)


def test_samples_mixed_in_half_precision() -> None:
    """Numbers below the least of float16 are compared too."""

    class Mixes(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer = nn.Linear(3, 4).half()

        def forward(self, x: Tensor) -> Tensor:
            y = self.layer(x.half()).float()
            return (y - y.mean(0, keepdim=True)) * 1e-9

    router, cells = VoronoiRouter(Mixes(), 5), torch.arange(200) % 5
    refuses("must treat samples one by one", router, torch.rand(200, 3), cells=cells, error=TypeError)


@pytest.mark.parametrize("way", ["loop", "grouped"])
def test_a_module_may_write_into_its_rows(way: str, generator: torch.Generator) -> None:
    class Writes(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.layer, self.late = nn.Linear(3, 4), False

        def forward(self, x: Tensor) -> Tensor:
            x[..., 0] *= 2
            result = self.layer(x)
            return result.cumsum(-1) if self.late else result.flip(-1)

    router = VoronoiRouter(Writes(), uniform(generator, 5, 3), coords="first3", way=way)
    x = uniform(generator, 120, 3)
    cells, written = router.diagram.locate(x), torch.cat([2 * x[:, :1], x[:, 1:]], 1)
    for late in (False, True, False, True):
        router.module.late = late
        router.zero_grad()
        actual = router(x.clone())
        actual.sum().backward()
        layer = router.module.layer
        plain = torch.einsum("nd,nod->no", written, layer.weight[cells]) + layer.bias[cells]
        torch.testing.assert_close(actual, plain.cumsum(-1) if late else plain.flip(-1))
        for cell, gradient in enumerate(layer.weight.grad):
            total = written[cells == cell].sum(0).expand(4, 3)
            torch.testing.assert_close(gradient, total * torch.arange(4, 0, -1)[:, None] if late else total)


class Fast(nn.Module):
    """A SIREN network: the factor 30 inside its sines amplifies rounding."""

    def __init__(self) -> None:
        super().__init__()
        self.layers, self.out = nn.ModuleList([nn.Linear(3 if i == 0 else 32, 32) for i in range(5)]), nn.Linear(32, 2)
        for i, layer in enumerate(self.layers):
            bound = 1 / 3 if i == 0 else (6 / 32) ** 0.5 / 30
            nn.init.uniform_(layer.weight, -bound, bound)

    def forward(self, x: Tensor) -> Tensor:
        for layer in self.layers:
            x = torch.sin(30 * layer(x))
        return self.out(x)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("make", [skip_net, LearnedSine, Fast, Heads])
def test_fused_under_autocast_is_as_near_to_float64_as_the_loop(make: type[nn.Module], dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(5)
    router = VoronoiRouter(make(), uniform(generator, 5, 3), coords="first3", fuse=True)
    perturb(router, generator, 0.01 if make is Fast else 0.2)
    x = uniform(generator, 120, 15 if make is skip_net else 3)
    router(x)  # the first call runs without autocast
    exact_router = copy.deepcopy(router).double()
    exact = masked_loop(exact_router, x.double())[0]
    with torch.autocast("cpu", dtype):
        actual, loop = (tensors(result)[0] for result in (router(x), masked_loop(router, x)))
    assert router.explain() == "forward: fused" and actual.dtype == loop.dtype
    weights, slopes = torch.randn(exact.shape, generator=generator), []
    for y, r in ((actual, router), (loop, router), (exact, exact_router)):
        slopes.append(torch.autograd.grad((y * weights.to(y)).sum(), [*r.parameters()], materialize_grads=True))
    for ours, theirs, right in ((actual, loop, exact), *zip(*slopes, strict=True)):
        error, other = ((y.double() - right).norm() for y in (ours, theirs))
        assert error <= 2 * other + FLOOR[dtype] * right.norm()


class Labelled(Tensor):
    """A tensor with column names, as in PINA; results of functions are of this class, but have no names."""

    @staticmethod
    def of(x: Tensor, labels: list[str]) -> Labelled:
        labelled = x.as_subclass(Labelled)
        labelled._labels = labels
        return labelled

    def __getitem__(self, index: Any) -> Labelled:
        return Labelled.of(super().__getitem__(index), self._labels)

    def reshape(self, *shape: Any) -> Labelled:
        return Labelled.of(super().reshape(*shape), self._labels)

    def clone(self, **options: Any) -> Labelled:
        return Labelled.of(super().clone(**options), self._labels)

    def column(self, name: str) -> Tensor:
        return self.as_subclass(Tensor)[..., self._labels.index(name)]


class Unsliced(Tensor):
    """A tensor subclass whose slices lack the column names."""

    column = Labelled.column


class Named(nn.Module):
    """A module using column names in one of four ways: always, if the input has names, to name results, or never."""

    def __init__(self, use: str) -> None:
        super().__init__()
        self.fc, self.use = nn.Linear(3, 2), use

    def forward(self, x: Tensor) -> Tensor:
        if self.use == "always":
            return self.fc(torch.stack([x.column(name) for name in "zyx"], -1))
        if self.use == "where there are some" and isinstance(x, Labelled):
            return -self.fc(x)
        return Labelled.of(self.fc(x), ["u", "v"]) if self.use == "for results" else self.fc(x)


WAYS: list[dict[str, Any]] = [{"fuse": True}, {"way": "grouped"}, {"way": "loop"}]


@pytest.mark.parametrize("options", WAYS)
def test_tensors_of_subclasses_are_taken_as_plain(generator: torch.Generator, options: dict[str, Any]) -> None:
    router, x = router_of(skip_net(), generator, **options), uniform(generator, 60, 15)
    leaf = x.clone().requires_grad_()
    expected = router(leaf)
    (slope,) = torch.autograd.grad(expected.sum(), leaf)
    labelled = Labelled.of(x.clone(), list("xyzabcdefghijkl")).requires_grad_()
    for _ in range(2):
        actual = router(labelled)
        assert type(actual) is Tensor
        torch.testing.assert_close(actual, expected)
        torch.testing.assert_close(torch.autograd.grad(actual.sum(), labelled)[0].as_subclass(Tensor), slope)
    torch.testing.assert_close(router(x, coords=Labelled.of(x[:, :3], list("xyz"))), expected)
    torch.testing.assert_close(router(labelled.reshape(6, 10, 15)), expected.reshape(6, 10, 4))
    assert router.explain().split(":")[1].split()[0] == options.get("way", "fused").replace("loop", "cell")


def test_a_layer_table_takes_subclasses_of_tensors(generator: torch.Generator) -> None:
    router, x = VoronoiRouter(NeRF(width=16, depth=2), uniform(generator, 3, 3)), uniform(generator, 20, 3)
    for a, b in zip(router(Labelled.of(x, list("xyz")), Labelled.of(x, list("xyz"))), router(x, x), strict=True):
        assert type(a) is Tensor
        torch.testing.assert_close(a, b)


@pytest.mark.filterwarnings("ignore:.*cell by cell")
@pytest.mark.parametrize("options", WAYS)
def test_modules_that_need_a_subclass_of_tensors_are_told(generator: torch.Generator, options: dict[str, Any]) -> None:
    x = uniform(generator, 60, 3)
    labelled, unsliced = Labelled.of(x, list("xyz")), x.as_subclass(Unsliced)
    unsliced._labels = list("xyz")
    for argument, name in ((labelled, "Labelled"), (unsliced, "Unsliced")):
        rule = rf"Named.forward must work with plain .*needs a {name} \(AttributeError: .*; extract"
        with pytest.raises(TypeError, match=rule):
            router_of(Named("always"), generator, **options)(argument)
    router = router_of(Named("where there are some"), generator, **options)
    router(x)
    rule = r"Named.forward must work with .* needs a Labelled \(its results differ\); extract"
    for _ in range(2):
        with pytest.raises(TypeError, match=rule):
            router(labelled)
    rule = "results must be plain tensors, got a Labelled; make it of the router's results"
    with pytest.raises(TypeError, match=rule):
        router_of(Named("for results"), generator, **options)(x)


class Bent(nn.Module):
    def forward(self, x: Tensor) -> Tensor:
        return torch.sin(x) * 2


@pytest.mark.filterwarnings("ignore:.*torch.jit", "ignore:.*cell by cell")
def test_compiled_parts_have_no_parameters(generator: torch.Generator) -> None:
    net = nn.Sequential(nn.Linear(3, 4), nn.Linear(4, 2))
    for module in (torch.jit.script(net), nn.Sequential(torch.jit.trace(net, torch.rand(5, 3)), nn.Linear(2, 2))):
        with pytest.raises(TypeError, match=r"is compiled by torch\.jit, and .* \(wrap the Python module\)"):
            VoronoiRouter(module, torch.rand(4, 3), coords="first3")
    module = nn.Sequential(nn.Linear(3, 4), torch.jit.script(Bent()), nn.Linear(4, 2))
    router, x = router_of(module, generator), uniform(generator, 60, 3)
    torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    router = router_of(module, generator, fuse=True)
    refuses("perhaps part '1', which torch.jit has compiled; use", router, x)


class Checkpointed(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.block, self.out = nn.Sequential(nn.Linear(3, 8), nn.Tanh()), nn.Linear(8, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.out(checkpoint(self.block, x, use_reentrant=True))


def test_reentrant_checkpoints_inside(generator: torch.Generator) -> None:
    router, x = router_of(Checkpointed(), generator), uniform(generator, 30, 3).requires_grad_()
    modules = [router.cell(i) for i in range(router.num_cells)]
    router(x).square().sum().backward()
    masked_loop(router, x, modules=modules)[0].square().sum().backward()
    for name, parameter in router.module.named_parameters():
        theirs = [m.get_parameter(name) for m in modules]
        grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in theirs]
        torch.testing.assert_close(parameter.grad, torch.stack(grads), rtol=1e-4, atol=1e-5)


def test_data_parallel(generator: torch.Generator, tmp_path: Any) -> None:
    router = router_of(skip_net(), generator)
    x = uniform(generator, 40, 15)
    router(x).square().sum().backward()
    wanted = [p.grad.clone() for p in router.parameters()]
    torch.distributed.init_process_group("gloo", init_method=f"file://{tmp_path}/store", rank=0, world_size=1)
    try:
        wrapped, before = nn.parallel.DistributedDataParallel(router), copy.deepcopy(router.state_dict())
        for _ in range(3):
            router.zero_grad()
            wrapped(x).square().sum().backward()
        for parameter, gradient in zip(router.parameters(), wanted, strict=True):
            torch.testing.assert_close(parameter.grad, gradient)
        router.subdivide(2, points=x[:, :3])
        message = "wraps the parameters of another number of cells; wrap the router again after subdivide or load"
        refuses(message, wrapped, x, error=RuntimeError)
        wrapped = nn.parallel.DistributedDataParallel(router)
        wrapped(x).sum().backward()
        router.load_state_dict(before)
        refuses(message, wrapped, x, error=RuntimeError)
    finally:
        torch.distributed.destroy_process_group()


def test_an_average_of_weights_is_split_with_its_router(generator: torch.Generator) -> None:
    """``AveragedModel`` holds a copy of the router with its own diagram; the recipe in the docs splits both."""
    router, x = router_of(skip_net(), generator), uniform(generator, 40, 15)
    router(x)
    average = torch.optim.swa_utils.AveragedModel(router, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(0.5))
    average.update_parameters(router)
    parents = router.subdivide(2, points=uniform(generator, 200, 3))
    average.module.subdivide(router.diagram, parents)
    average.update_parameters(router)
    torch.testing.assert_close(average(x), router(x))


class Decides(nn.Module):
    """A module that branches on whether any sample meets a condition, or on its negation."""

    def __init__(self, inverted: bool) -> None:
        super().__init__()
        self.lin, self.inverted = nn.Linear(3, 2), inverted

    def forward(self, x: Tensor) -> Tensor:
        condition = (x[:, 0] > 0.2).any()
        if self.inverted:
            return self.lin(x) if torch.logical_not(condition) else -self.lin(x)
        return -self.lin(x) if condition else self.lin(x)


@pytest.mark.filterwarnings("ignore:.*cell by cell")
@pytest.mark.parametrize("inverted", [False, True])
def test_decisions_are_those_of_each_cell_or_refused(generator: torch.Generator, inverted: bool) -> None:
    router = router_of(Decides(inverted), generator)
    x = uniform(generator, 60, 3)
    x[:, 0] = -x[:, 0].abs()
    torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    x[7, 0] = 0.5
    try:
        result = router(x)
    except TypeError as error:
        assert "mixes samples" in str(error)
    else:
        torch.testing.assert_close(result, masked_loop(router, x)[0])
