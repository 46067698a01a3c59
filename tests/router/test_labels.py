"""Labels in place of positions: one network for each speaker, station, object or image."""

from __future__ import annotations

import copy
import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import refuses
from ops.foreign_fields import Heads, LearnedSine
from router_loop import Built, gradients, masked_loop, perturb, tensors
from torch import Tensor, nn

from voronerf import NeRF, VoronoiDiagram, VoronoiRouter
from voronerf.nerf.radiance import radiance_of

K = 5
WAYS: dict[str, dict[str, Any]] = {
    "fused": {"fuse": True},
    "grouped": {"way": "grouped"},
    "loop": {"way": "loop"},
}


def routed(module: nn.Module, way: str = "fused", cells: Any = K, **options: Any) -> VoronoiRouter:
    return perturb(VoronoiRouter(module, cells, **WAYS[way], **options), torch.Generator().manual_seed(3))


def drawn(generator: torch.Generator, *shape: int, dtype: torch.dtype = torch.int64) -> Tensor:
    """Draws labels of all networks except the last one, which gets no sample."""
    return torch.randint(K - 1, shape, generator=generator, dtype=dtype)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("dtype", [torch.int32, torch.int64])
def test_every_way_equals_the_loop_with_gradients(way: str, dtype: torch.dtype, generator: torch.Generator) -> None:
    router = routed(LearnedSine(), way)
    for n in (40, 23, 1):  # a first call, a call with a cached program, a single sample
        x, cells = torch.rand(n, 3, generator=generator, requires_grad=True), drawn(generator, n, dtype=dtype)
        actual, (expected,) = router(x, cells=cells), masked_loop(router, x, cells=cells)
        leaves = [*router.parameters(), x]
        torch.testing.assert_close(actual, expected)
        torch.testing.assert_close(gradients(actual, leaves), gradients(expected, leaves))
    assert router.explain() == f"forward: {'cell by cell' if way == 'loop' else way}"
    assert router(torch.rand(0, 3), cells=torch.zeros(0, dtype=dtype)).shape == (0, 2)


@pytest.mark.parametrize("way", WAYS)
def test_labels_have_the_leading_shape_of_samples(way: str, generator: torch.Generator) -> None:
    router, x, cells = routed(LearnedSine(), way), torch.rand(8, 6, 3, generator=generator), drawn(generator, 8, 6)
    flat = router(x.flatten(0, 1), cells=cells.flatten())
    torch.testing.assert_close(router(x, cells=cells), flat.reshape(8, 6, 2))
    for n in (8, 1):  # an ensemble: every network gets each row
        expected = torch.stack([router.cell(i)(x[:n, 0]) for i in range(K)], 1)
        torch.testing.assert_close(router(x[:n, :1], cells=torch.arange(K).expand(n, K)), expected)


@pytest.mark.parametrize("way", ["grouped", "loop"])
def test_what_lies_behind_the_shape_of_labels_is_one_sample(way: str, generator: torch.Generator) -> None:
    module = Built(lambda net, x: net.layer(x).softmax(-2), layer=(3, 2))  # over all rows of an image
    router, x, images = routed(module, way), torch.rand(9, 6, 3, generator=generator), drawn(generator, 9)
    torch.testing.assert_close(router(x, cells=images), masked_loop(router, x, cells=images)[0])


@pytest.mark.parametrize("fuse", [False, True])
def test_fields_methods_autocast_and_double_precision(fuse: bool, generator: torch.Generator) -> None:
    x, d, cells = (*(torch.rand(30, 3, generator=generator) for _ in range(2)), drawn(generator, 30))
    field = routed(NeRF(width=16, depth=2), "fused")
    torch.testing.assert_close(tensors(field(x, d, cells=cells)), masked_loop(field, x, d, cells=cells))
    index = torch.arange(30, dtype=torch.int32)
    torch.testing.assert_close(field(x, d, index, cells=cells), field(x, d, cells=cells))
    heads = routed(Heads(), "fused" if fuse else "grouped", methods=["density"])
    colour, sigma = heads(x, d, cells=cells)
    torch.testing.assert_close([colour, sigma], masked_loop(heads, x, d, cells=cells))
    torch.testing.assert_close(heads.density(x, cells=cells)["sigma"], sigma)
    torch.testing.assert_close(heads.density(x, cells=0 * cells)["sigma"], heads.cell(0).density(x)["sigma"])
    router = routed(LearnedSine(), "fused" if fuse else "grouped")
    with torch.autocast("cpu", torch.bfloat16):
        half = router(x, cells=cells)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), router(x, cells=cells), atol=0.05, rtol=0.05)
    router.double()
    torch.testing.assert_close(router(x.double(), cells=cells), masked_loop(router, x.double(), cells=cells)[0])


def test_a_diagram_gives_way_to_labels(generator: torch.Generator) -> None:
    for way in WAYS:
        router = routed(LearnedSine(), way, torch.rand(K, 3, generator=generator), coords="first3")
        x, cells = torch.rand(30, 3, generator=generator), drawn(generator, 30)
        torch.testing.assert_close(router(x, cells=cells), masked_loop(router, x, cells=cells)[0])
        torch.testing.assert_close(router(x), masked_loop(router, x)[0])
    drawing = routed(Heads(), "grouped", router.diagram, coords="first3", assignment="stochastic", methods=["density"])
    torch.testing.assert_close(drawing(x, cells=cells), masked_loop(drawing, x, cells=cells)[0])  # no cells are drawn


def test_a_module_with_an_argument_of_this_name_gets_it(generator: torch.Generator) -> None:
    class Own(nn.Linear):
        def forward(self, x: Tensor, cells: Tensor) -> Tensor:
            return super().forward(x) * cells[..., None]

    x, cells = torch.rand(30, 3, generator=generator), drawn(generator, 30)
    router = routed(Own(3, 2), "grouped", torch.rand(K, 3, generator=generator), coords="first3")
    torch.testing.assert_close(router(x, cells=cells), masked_loop(router, x, cells)[0])
    refuses("Own.forward has an argument cells itself, so a router without centres", routed, Own(3, 2), "grouped")

    class Coords(nn.Linear):
        def forward(self, coords: Tensor) -> Tensor:
            return super().forward(coords)

    router = routed(Coords(3, 2), "grouped")
    torch.testing.assert_close(router(coords=x, cells=cells), router(x, cells=cells))


@pytest.mark.parametrize("way", WAYS)
def test_an_argument_per_ray_may_come_first(way: str, generator: torch.Generator) -> None:
    module = Built(lambda net, shift, x: net.layer(x) + shift[..., :2].reshape(*x.shape[:-1], 2), layer=(3, 2))
    router, x, cells = routed(module, way), torch.rand(9, 6, 3, generator=generator), drawn(generator, 9, 6)
    shift = torch.rand(9, 3, generator=generator)
    expected = masked_loop(router, shift.repeat_interleave(6, 0), x.flatten(0, 1), cells=cells.flatten())
    torch.testing.assert_close(router(shift, x, cells=cells).flatten(0, 1), expected[0])


@pytest.mark.parametrize("way", WAYS)
def test_a_vector_for_each_label(way: str, generator: torch.Generator) -> None:
    module = Built(lambda net, x: net.vector.expand(len(x), -1), vector=nn.Parameter(torch.zeros(4)))
    router, cells = routed(module, way), drawn(generator, 20)
    result, vectors = router(cells, cells=cells), router.module.vector
    torch.testing.assert_close(result, vectors[cells])
    torch.testing.assert_close(gradients(result, [vectors]), gradients(vectors[cells], [vectors]))


@pytest.mark.parametrize("way", WAYS)
def test_frozen_networks_learn_nothing(way: str, generator: torch.Generator) -> None:
    router, x, cells = routed(LearnedSine(), way), torch.rand(40, 3, generator=generator), drawn(generator, 40)
    before, values = gradients(router(x, cells=cells), [*router.parameters()]), router(x, cells=cells)
    router.freeze([1, 2])
    torch.testing.assert_close(router(x, cells=cells), values)
    for full, kept in zip(before, gradients(router(x, cells=cells), [*router.parameters()]), strict=True):
        assert not kept[[1, 2]].any()
        torch.testing.assert_close(kept[[0, 3, 4]], full[[0, 3, 4]])


@pytest.mark.parametrize("way", WAYS)
def test_labels_are_checked(way: str) -> None:
    router, x = routed(LearnedSine(), way), torch.rand(20, 3)
    router(x, cells=torch.zeros(20, dtype=torch.int64))
    few, rule = torch.zeros(20, dtype=torch.int64), "cells must have the leading shape of the samples, such as [n]"
    for cells, kind, message in (
        (few - 1, ValueError, "cells must lie in 0 to 4, got values from -1 to -1"),
        (few.int() + K, ValueError, "cells must lie in 0 to 4, got values from 5 to 5"),
        (few.index_fill(0, torch.tensor([3]), 2**32), ValueError, "cells must lie in 0 to 4, got values from 0 to 42"),
        (few.float(), TypeError, "cells must be an int32 or int64 tensor, got torch.float32"),
        (few.bool(), TypeError, "cells must be an int32 or int64 tensor, got torch.bool"),
        (3, TypeError, "cells must be an int32 or int64 tensor, got int"),
        (few[0], ValueError, f"{rule}, got []"),
        (few.to("meta"), ValueError, "cells must be on the device of the parameters, cpu, got meta"),
        (few[:7], ValueError, f"{rule} for [n, f], got [7] beside [20, 3]"),
        (few[:, None], ValueError, f"{rule} for [n, f], got [20, 1] beside [20, 3]"),
        (few[None], ValueError, f"{rule} for [n, f], got [1, 20] beside [20, 3]"),
        (None, ValueError, "cells must be given to each call of a router without centres"),
    ):
        with pytest.raises(kind, match=re.escape(f"VoronoiRouter: {message}")):
            router(x, cells=cells)
    refuses("coords must be None where cells are given, got both", router, x, coords=x, cells=few)
    refuses("cells must be given", router, x, coords=x)
    for arguments, got in (((), "no argument"), ((x.numpy(),), "ndarray"), ((x.tolist(),), "list")):
        with pytest.raises(TypeError, match=f"must include a tensor with a row for each sample, got {got}; pass torch"):
            router(*arguments, cells=few)


def test_what_needs_centres_is_refused() -> None:
    net, router = nn.Linear(3, 2), VoronoiRouter(nn.Linear(3, 2), K)
    placed = VoronoiRouter(net, torch.rand(K, 3), coords="first3")
    for make, kind, message in (
        (lambda: VoronoiRouter(net, 0), ValueError, "k must be at least 1, got 0"),
        (lambda: VoronoiRouter(net, True), TypeError, "or a number of networks, got True"),
        (lambda: VoronoiRouter(net, 2.5), TypeError, "or a number of networks, got 2.5"),
        (lambda: VoronoiRouter(net, K, coords="first3"), ValueError, "coords must be None without centres"),
        (lambda: VoronoiRouter(net, K, assignment="stochastic"), ValueError, "assignment must be 'nearest' without"),
        (lambda: router.subdivide(2, points=torch.rand(9, 3)), ValueError, "diagram must be VoronoiDiagram.without"),
        (lambda: router.subdivide(VoronoiDiagram.without_centres(9)), ValueError, "with parents"),
        (lambda: router.subdivide(placed.diagram, torch.arange(K)), ValueError, "VoronoiDiagram.without_centres"),
        (lambda: placed.subdivide(VoronoiDiagram.without_centres(K), torch.arange(K)), ValueError, "must have centres"),
        (lambda: router.diagram.locate(torch.rand(4, 3)), ValueError, "locate: a diagram without centres"),
        (lambda: router.diagram.sample_cell(torch.rand(4, 3), temperature=1), ValueError, "sample_cell: a diagram"),
        (lambda: VoronoiRouter.from_modules([net, net], 3), ValueError, "of 3 cells, got 2"),
    ):
        with pytest.raises(kind, match=message):
            make()
    field = VoronoiRouter(NeRF(width=16, depth=2), K)
    assert field.program(torch.rand(2, 3), torch.rand(2, 3)) == radiance_of(field) == "labels decide the cells"


def test_states_parts_copies_and_new_labels(tmp_path: Path, generator: torch.Generator) -> None:
    router, x, cells = routed(LearnedSine()), torch.rand(30, 3, generator=generator), drawn(generator, 30)
    values = router(x, cells=cells)
    torch.save(router.state_dict(), tmp_path / "state.pt")
    other = VoronoiRouter(LearnedSine(), 2, fuse=True)
    other.load_state_dict(torch.load(tmp_path / "state.pt"))
    for same in (other, copy.deepcopy(router), pickle.loads(pickle.dumps(router))):
        assert same.num_cells == K and torch.equal(same(x, cells=cells), values)
    modules = [router.cell(i) for i in range(K)]
    torch.testing.assert_close(VoronoiRouter.from_modules(modules)(x, cells=cells), values)
    part = router.part([1, 3])
    torch.testing.assert_close(part(x, cells=torch.ones(30, dtype=torch.int64)), router.cell(3)(x))
    assert part.num_cells == 2 and "num_cells=2, without centres" in repr(part)
    optimizer = torch.optim.Adam(router.parameters())
    router(x, cells=cells).square().sum().backward()
    optimizer.step()
    router.subdivide(VoronoiDiagram.without_centres(K + 1), torch.tensor([*range(K), 2]), optimizer=optimizer)
    torch.testing.assert_close(router(x, cells=torch.full((30,), K)), router.cell(2)(x))
    assert all(state["exp_avg"].shape[0] == K + 1 for state in optimizer.state.values())


@pytest.mark.parametrize("whole", [False, True])
def test_graphs_of_the_compiler(whole: bool, generator: torch.Generator) -> None:
    router, x, cells = routed(LearnedSine(), "fused" if whole else "grouped"), torch.rand(40, 3), drawn(generator, 40)
    expected = router(x, cells=cells)
    torch._dynamo.reset()  # forget the graphs of the other case

    def twice(x: Tensor, cells: Tensor) -> Tensor:
        return 2 * router(x, cells=cells)

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        compiled = torch.compile(twice, backend="eager", fullgraph=whole)
        torch.testing.assert_close(compiled(x, cells), 2 * expected)
        with pytest.raises(ValueError, match="cells must lie in 0 to 4, got values from -1 to 0"):
            compiled(x, (0 * cells).index_fill(0, torch.tensor([1]), 2**40))


def test_gradients_by_torch_func(generator: torch.Generator) -> None:
    router, x, cells = routed(LearnedSine()), torch.rand(30, 3, generator=generator), drawn(generator, 30)
    parameters = dict(router.named_parameters())

    def loss(parameters: dict[str, Tensor], cells: Tensor) -> Tensor:
        return torch.func.functional_call(router, parameters, (x,), {"cells": cells}).square().sum()

    actual = torch.func.grad(loss)(parameters, cells)
    expected = torch.autograd.grad(router(x, cells=cells).square().sum(), list(parameters.values()))
    torch.testing.assert_close(tuple(actual.values()), expected)
