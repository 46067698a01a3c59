"""VoronoiRouter on modules of many makes: equal to a loop over masks, in one pass where the module allows it."""

from __future__ import annotations

import warnings

import pytest
import torch
from router_fields import BY_CELL, ONE_PASS, Inputs, gradients, masked_loop, perturb, tensors
from torch import nn

from voronerf.router import VoronoiRouter

CASES = [pytest.param(make, inputs, id=make.__name__) for make, inputs in ONE_PASS + BY_CELL]


@pytest.fixture
def generator() -> torch.Generator:
    return torch.Generator().manual_seed(3)


@pytest.fixture(autouse=True)
def _quiet() -> None:
    warnings.filterwarnings("ignore", message="VoronoiRouter: .* cell by cell")


@pytest.mark.parametrize(("make", "inputs"), CASES)
def test_identical_cells_are_the_module(make: type[nn.Module], inputs: Inputs, generator: torch.Generator) -> None:
    module = make()
    args = inputs(61, torch.float32, generator)
    for k in (1, 7):
        router = VoronoiRouter(module, torch.randn(k, 3, generator=generator), coords="first3")
        for found, expected in zip(tensors(router(*args)), tensors(module(*args)), strict=True):
            torch.testing.assert_close(found, expected)


@pytest.mark.parametrize(("make", "inputs"), CASES)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_distinct_cells_equal_a_loop_over_masks(
    make: type[nn.Module], inputs: Inputs, generator: torch.Generator, dtype: torch.dtype
) -> None:
    """Results and gradients; in float64 second derivatives as well."""
    module = make().to(dtype)
    router = perturb(VoronoiRouter(module, torch.randn(9, 3, generator=generator), coords="first3"), generator)
    args = inputs(40, dtype, generator)
    for value in args:
        value.requires_grad_(make.__name__ != "Norms")
    cells = router.diagram.locate(args[0][:, :3])
    tolerance = {"rtol": 1e-9, "atol": 1e-9} if dtype == torch.float64 else {"rtol": 1e-4, "atol": 2e-4}
    leaves = [value for value in args if value.requires_grad]
    # The second derivative of torch._weight_norm itself is wrong: gradgradcheck refuses it.
    for second in (False, True) if dtype == torch.float64 and make.__name__ != "Tied" else (False,):
        found = tensors(router(*args))
        expected, modules = masked_loop(router, cells, args)
        factors = [torch.randn(r.shape, generator=generator).to(r) for r in expected]
        for a, b in zip(found, expected, strict=True):
            torch.testing.assert_close(a, b, **tolerance)
        names = [name for name, _ in router.module.named_parameters()]
        ours = gradients(found, factors, [*leaves, *router.module.parameters()], second)
        plain = [*leaves, *(m.get_parameter(name) for name in names for m in modules)]
        theirs = gradients(expected, factors, plain, second)
        count = len(leaves)
        for a, b in zip(ours[:count], theirs[:count], strict=True):
            torch.testing.assert_close(a, b, **tolerance)
        for i, name in enumerate(names):
            stacked = torch.stack(theirs[count + i * len(modules) : count + (i + 1) * len(modules)])
            torch.testing.assert_close(ours[count + i], stacked, **tolerance, msg=lambda text, name=name: name + text)
