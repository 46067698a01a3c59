"""Tests of fields that declare their program: routers equal a loop over cells, and follow changes of the field."""

from __future__ import annotations

import types
from typing import Any

import pytest
import torch
from helpers import refuses
from router_loop import masked_loop
from torch import Tensor, nn

from voronerf import MLP, Layer, NeRF, VoronoiRouter, frequency_encode
from voronerf.router import CellProgram, layered_program

K, N = 5, 60
TABLE = MLP((Layer(("positions",), 6, "relu"), Layer((0,), 4)), outputs=(1,))


class Said(nn.Module):
    def __init__(self, act: Any = torch.sigmoid) -> None:
        super().__init__()
        self.first, self.second, self.act = nn.Linear(3, 6), nn.Linear(6, 4), act

    def program(self) -> CellProgram:
        return layered_program(TABLE, [self.first, self.second], self.activate)

    def activate(self, raw: Tensor) -> Any:
        return self.act(raw)

    def forward(self, positions: Tensor) -> Any:
        return self.act(self.second(self.first(positions).relu()))


class Viewed(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.flat, self.bias = nn.Parameter(torch.rand(12)), nn.Parameter(torch.rand(4))

    def program(self) -> CellProgram:
        weight = self.flat.unflatten(-1, (4, 3))
        layer: Any = types.SimpleNamespace(weight=weight, bias=self.bias)
        return layered_program(MLP((Layer(("positions",), 4),), outputs=(0,)), [layer], torch.sigmoid)

    def forward(self, positions: Tensor) -> Tensor:
        return (positions @ self.flat.unflatten(-1, (4, 3)).T + self.bias).sigmoid()


def make(field: nn.Module | None = None, **options: Any) -> VoronoiRouter:
    router = VoronoiRouter(Said() if field is None else field, torch.rand(K, 3), **options)
    with torch.no_grad():
        for p in router.module.parameters():
            p += 0.1 * torch.randn(p.shape)
    return router


def agree(router: VoronoiRouter, *args: Tensor, **allowed: float) -> None:
    assert router.explain() == "forward: fused"
    result = router(*args)
    result = result if isinstance(result, tuple) else (result,)
    for a, b in zip(result, masked_loop(router, *args), strict=True):
        assert a.dtype == b.dtype
        torch.testing.assert_close(a, b, **{"rtol": 1e-4, "atol": 1e-5, **allowed})


@pytest.mark.parametrize("context", [torch.no_grad, torch.inference_mode, torch.enable_grad])
def test_views_of_parameters_follow_their_parameters(context: Any) -> None:
    """A program may read views of parameters; the views are made again where the parameters get other memory."""
    router, x = make(Viewed()), torch.rand(N, 3)
    agree(router, x)
    router.module.flat.data = router.module.flat.data * 2
    with context():
        agree(router, x)
        router.subdivide(router.diagram.refine({1: torch.rand(2, 3)})[0])
        agree(router, x)
    router(x).sum().backward()
    assert router.module.flat.grad is not None


CHANGES: dict[str, Any] = {
    "weight": lambda r: setattr(r.module.second, "weight", nn.Parameter(torch.randn(K, 4, 6))),
    "layer": lambda r: setattr(r.module, "second", make().module.second),
    "module": lambda r: setattr(r, "module", make().module),
    "activation": lambda r: [setattr(r.module, name, torch.tanh) for name in ("act", "activate")],
}


@pytest.mark.parametrize("name", CHANGES)
def test_what_changes_is_followed(name: str) -> None:
    router, x = make(), torch.rand(N, 3)
    agree(router, x)
    CHANGES[name](router)
    agree(router, x)
    router(x).sum().backward()
    assert all(p.grad is not None for p in router.module.parameters())


def test_a_layer_that_is_no_longer_tied_and_one_with_a_new_bias() -> None:
    class Tied(Said):
        def __init__(self) -> None:
            super().__init__()
            self.first, self.second = nn.Linear(3, 3, bias=False), nn.Linear(3, 3, bias=False)
            self.second.weight = self.first.weight

        def program(self) -> CellProgram:
            table = MLP((Layer(("positions",), 3, "relu"), Layer((0,), 3)), outputs=(1,))
            return layered_program(table, [self.first, self.second], self.activate)

    router, x = make(Tied()), torch.rand(N, 3)
    agree(router, x)
    router.module.second.weight = nn.Parameter(torch.randn(K, 3, 3))
    agree(router, x)
    router.module.first.bias = nn.Parameter(torch.randn(K, 3))
    agree(router, x)


@pytest.mark.parametrize(
    "act",
    [
        lambda raw: raw * torch.tensor([1.0, 2, 3, 4]),
        lambda raw: torch.nn.functional.normalize(raw, dim=1),
        lambda raw: raw.sort(dim=1).values,
        lambda raw: raw @ torch.ones(4, 2),
    ],
    ids=["constants", "norms", "sorts", "products"],
)
def test_any_activation_stays_behind_the_fused_layers(act: Any) -> None:
    agree(make(Said(act)), torch.rand(N, 3))


def test_results_keep_their_structure() -> None:
    router = make(Said(lambda raw: {"colour": raw[:, :3], "density": [raw[:, 3]]}))
    result = router(torch.rand(N, 3))
    assert result.keys() == {"colour", "density"} and isinstance(result["density"], list)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16, torch.float64])
def test_parameters_of_other_dtypes(dtype: torch.dtype) -> None:
    router = make().to(dtype)
    wide = {} if dtype is torch.float64 else {"rtol": 0.02, "atol": 0.02}
    agree(router, torch.rand(N, 3, dtype=dtype), **wide)


class Scaled(Said):
    def __init__(self) -> None:
        super().__init__(None)
        self.scale = nn.Parameter(torch.tensor(2.0))

        self.act = self.scaled

    def scaled(self, raw: Tensor) -> Tensor:
        return raw.sigmoid() * self.scale


def test_each_cell_may_have_its_parameter_of_the_activation() -> None:
    router, x = make(Scaled()), torch.rand(N, 3)
    result = router(x)
    assert router.explain().startswith("forward: grouped") and len(router.module.scale.unique()) == K
    torch.testing.assert_close(result, *masked_loop(router, x))


def test_wide_positions_are_encoded_as_they_are() -> None:
    class Far(Said):
        def __init__(self) -> None:
            super().__init__(torch.sigmoid)
            self.first = nn.Linear(39, 6)

        def program(self) -> CellProgram:
            table = MLP(TABLE.layers, TABLE.outputs, position_octaves=6)
            return layered_program(table, [self.first, self.second], self.activate)

        def forward(self, positions: Tensor) -> Any:
            return super().forward(frequency_encode(positions, 6).float())

    agree(make(Far()), 100 * torch.rand(N, 3, dtype=torch.float64))


def test_a_parameter_of_the_activation_learns() -> None:
    router, x = make(Scaled(), share=["scale"]), torch.rand(N, 3)
    before = router(x)
    before.sum().backward()
    assert float(router.module.scale.grad) != 0
    with torch.no_grad():
        router.module.scale.mul_(2)
    torch.testing.assert_close(router(x), 2 * before)


def test_all_parameters_may_be_shared() -> None:
    router = make(share=["*"])
    agree(router, torch.rand(N, 3))


def test_weight_norm_afterwards_is_refused() -> None:
    router = make()
    router(torch.rand(N, 3))
    torch.nn.utils.parametrizations.weight_norm(router.module.second)
    refuses("module must keep the parameters that it was wrapped with", router, torch.rand(N, 3), error=TypeError)


@pytest.mark.native
def test_is_part_of_a_graph_before_any_call_and_with_directions_of_rays() -> None:
    torch.compiler.reset()
    router, x = VoronoiRouter(NeRF(width=16, depth=2), torch.rand(K, 3)), torch.rand(N, 3)
    rays, index = nn.functional.normalize(torch.rand(4, 3), dim=1), (torch.arange(N) % 4).int()
    compiled = torch.compile(router, fullgraph=True, backend="eager")
    for a, b in zip(compiled(x, rays, index), router(x, rays[index]), strict=True):
        torch.testing.assert_close(a, b)


def test_refuses_what_is_no_program() -> None:
    class Nothing(Said):
        def program(self) -> Any:
            return None

    class Turned(Said):
        def program(self) -> CellProgram:
            return super().program()._replace(reads=(1, 0))

    class Unrelated(Said):
        def program(self, name: str) -> Any:
            raise AssertionError

    refuses("program of Nothing must give a CellProgram, got NoneType", make, Nothing(), error=TypeError)
    with pytest.raises(ValueError, match=r"program of Turned must read positions, .* got reads \(1, 0\)"):
        make(Turned())
    router = make(Unrelated(), coords="first3")
    assert router(torch.rand(N, 3)).shape == (N, 4)
