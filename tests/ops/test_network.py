"""Networks that learn from the gradient of a loss to their outputs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from op_cases import refused

from voronerf import MLP, HashGrid, Layer
from voronerf.ops import Cells, Network, routed_mlp
from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.program import Builder

pytestmark = pytest.mark.op("grouped_program")

GRID = HashGrid(levels=2, features=2, log2_entries=10, finest=20)
TABLE = MLP(
    (Layer(("positions",), 8, "relu"), Layer((0, "directions"), 3)), outputs=(1,), position_encoding="hash", grid=GRID
)
PROGRAM = TABLE.program(3, 2, None, (True, False), ray=True)


def network(device, n=40, k=3):
    """Returns the arguments of a network of k cells, which share a table, with one direction for each of seven rays."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(shape, generator=generator).to(device)

    weights = [draw(k, o, i).requires_grad_() for o, i in TABLE.weight_shapes(3, 2)]
    biases = [draw(k, 8).requires_grad_(), None]
    return {
        "positions": draw(n, 3),
        "weights": weights,
        "biases": biases,
        "layers": TABLE,
        "centres": draw(k, 3) if k > 1 else None,
        "directions": draw(7, 2),
        "direction_index": torch.arange(n, device=device, dtype=torch.int32) % 7,
        "features": draw(*GRID.table_shape).requires_grad_(),
    }


def forward(arguments, backend="auto"):
    """Returns the outputs of the same network as a program, and their tape."""
    cells = Cells(**{name: arguments[name] for name in ("centres", "frozen", "rows") if name in arguments})
    network = Network(PROGRAM, parameters_of(arguments))
    inputs, index = [arguments["positions"], arguments["directions"]], arguments["direction_index"]
    (raw,), tape = network.fwd(inputs, cells, ray_index=index, backend=backend)
    assert not raw.requires_grad
    return raw.float(), tape


@pytest.mark.parametrize("k", [1, 2])
def test_rows_beyond_the_tensor_or_below_0_do_not_count(k):
    for rows, count in ((-1, 0), (0, 0), (5, 5), (9, 5)):
        cells = Cells(centres=torch.zeros(k, 3), rows=torch.tensor([rows], dtype=torch.int32))
        assert cells.sort(torch.rand(5, 3), k).offsets.tolist() == [0, *[count] * k]


def parameters_of(arguments):
    return [*arguments["weights"], arguments["biases"][0], arguments["features"]]


def squares(out):
    """Returns a loss that weights the rows differently, and its gradient."""
    factor = torch.linspace(0.5, 2, max(len(out), 1), device=out.device)[: len(out), None]
    return (factor * out.square()).sum(), 2 * factor * out


def learn(arguments, *, backward=False, backend="auto"):
    """Returns the loss; with ``backward`` its gradients are added immediately instead of deferred."""
    raw, tape = forward(arguments, backend)
    loss, gradient = squares(raw)
    return tape.learn(loss, [gradient], defer=not backward)


def composed(arguments):
    """Returns the same loss, differentiated by torch."""
    out, _ = routed_mlp(**arguments, backend="reference")
    return squares(out)[0]


@pytest.mark.parametrize(("n", "k"), [(0, 3), (1, 1), (40, 1), (40, 3)])
@pytest.mark.parametrize("backward", [False, True])
def test_equals_its_parts(device, backend, n, k, backward):
    assert_equals_its_parts(network(device, n, k), network(device, n, k), backend, backward)


def assert_equals_its_parts(arguments, expected, backend, backward=False):
    loss = learn(arguments, backward=backward, backend=backend)
    wanted = composed(expected)
    assert loss.requires_grad != backward
    if not backward:
        (3 * loss).backward()
    wanted.backward()
    torch.testing.assert_close(loss.detach(), wanted.detach(), rtol=1e-4, atol=1e-5)
    for actual, other in zip(parameters_of(arguments), parameters_of(expected), strict=True):
        factor = 1 if backward else 3
        torch.testing.assert_close(actual.grad, factor * other.grad, rtol=1e-4, atol=1e-4)
    assert arguments["positions"].grad is None and arguments["directions"].grad is None


def assert_same(actual, expected):
    """Compares bit for bit, except gradients of a hash grid's table on a GPU, which are sums in any order."""
    for place, (one, other) in enumerate(zip(actual, expected, strict=True)):
        if one.is_cuda and place == len(actual) - 1:
            torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-4)
        else:
            assert torch.equal(one, other)


def test_gradients_at_once_are_those_of_backward_bit_for_bit(device, backend):
    """Gradients are added to existing gradients, as autograd does."""
    arguments, expected = network(device), network(device)
    for _ in range(2):
        learn(arguments, backward=True, backend=backend)
        learn(expected, backend=backend).backward()
    assert_same(*([p.grad for p in parameters_of(call)] for call in (arguments, expected)))


def test_only_what_needs_gradients_gets_them(device, backend):
    for frozen in ((0,), (0, 1, 2), (3,), (0, 1, 2, 3)):
        arguments = network(device)
        parameters = parameters_of(arguments)
        for number in frozen:
            parameters[number].requires_grad_(False)
        if len(frozen) < 4:
            learn(arguments, backward=True, backend=backend)
        assert [p.grad is None for p in parameters] == [number in frozen or len(frozen) == 4 for number in range(4)]


def test_a_detached_layer_gets_no_gradient(device, backend):
    b = Builder()
    hidden = b.apply("stop", b.linear(b.input(3), b.parameter(4, 3), 4))
    program = b.program([b.linear(hidden, b.parameter(2, 4), 2)])
    weights = [
        torch.randn(1, 4, 3, device=device).requires_grad_(),
        torch.randn(1, 2, 4, device=device).requires_grad_(),
    ]
    (raw,), tape = Network(program, weights).fwd([torch.randn(5, 3, device=device)], Cells(), backend=backend)
    loss, gradient = squares(raw)
    tape.learn(loss, [gradient])
    assert weights[0].grad is None and weights[1].grad is not None


def test_gradients_reach_what_parameters_are_made_of(device, backend):
    """A shared layer is one parameter expanded to all cells, and autograd sums its gradients over the cells."""
    results = []
    for backward in (True, False):
        arguments = network(device)
        shared = arguments["weights"][0].detach()[0].clone().requires_grad_()
        arguments["weights"][0] = shared.expand(3, -1, -1)
        loss = learn(arguments, backward=backward, backend=backend)
        if not backward:
            loss.backward()
        results.append([shared.grad, *(p.grad for p in parameters_of(arguments)[1:])])
    assert_same(*results)


def test_hooks_of_parameters_are_called(device, backend):
    arguments, called = network(device), []
    first, second = arguments["weights"]
    first.register_hook(lambda gradient: called.append(gradient.shape))
    second.register_post_accumulate_grad_hook(lambda parameter: called.append(parameter.shape))
    learn(arguments, backward=True, backend=backend)
    assert sorted(called) == sorted((first.shape, second.shape))


def test_a_loss_without_gradients_to_anything(device, backend):
    with torch.no_grad():
        loss = learn(network(device), backend=backend)
    assert not loss.requires_grad and float(loss) > 0


def test_under_autocast(device, backend):
    arguments = network(device)
    with torch.autocast(torch.device(device).type, torch.bfloat16):
        loss = learn(arguments, backend=backend)
    loss.backward()
    torch.testing.assert_close(loss.detach(), composed(network(device)).detach(), rtol=0.05, atol=0.0)
    assert all(parameter.grad.dtype == torch.float32 for parameter in parameters_of(arguments))


@pytest.mark.parametrize("k", [1, 3])
def test_frozen_cells_and_the_rows_that_count(k, backend):
    """Frozen cells have no gradient; rows beyond the row count have neither gradient nor output."""
    more = {"frozen": torch.arange(k) == 1, "rows": torch.tensor([30], dtype=torch.int32)}
    assert_equals_its_parts(*({**network("cpu", k=k), **more} for _ in range(2)), backend=backend)


def test_is_once_differentiable(device, backend):
    arguments = network(device)
    loss = learn(arguments, backend=backend)
    with pytest.raises(RuntimeError):
        gradients = torch.autograd.grad(loss, parameters_of(arguments), create_graph=True)
        torch.autograd.grad(sum(gradient.square().sum() for gradient in gradients), arguments["weights"][0])


def test_a_tape_gives_the_gradients_that_autograd_gives(device, backend):
    """Each gradient alone equals the gradient by autograd, and is None if it is unwanted."""
    arguments = network(device)
    leaves = [arguments["positions"], arguments["directions"], *parameters_of(arguments)]
    for leaf in leaves:
        leaf.requires_grad_()
    out, _ = routed_mlp(**arguments, backend="reference")
    arriving = torch.randn_like(out)
    expected = torch.autograd.grad(out, leaves, arriving)
    for index in range(len(leaves)):
        _, tape = forward(arguments, backend)
        actual = tape.backward([arriving], [i == index for i in range(len(leaves))])
        assert [g is None for g in actual] == [i != index for i in range(len(leaves))]
        torch.testing.assert_close(actual[index], expected[index], rtol=1e-4, atol=1e-4)
    for actual, wanted in zip(tape.backward([arriving]), expected, strict=True):  # a tape may be used again
        torch.testing.assert_close(actual, wanted, rtol=1e-4, atol=1e-4)
    arguments["positions"].requires_grad_(False)
    _, tape = forward(arguments, backend)
    assert tape.backward([arriving], [True] * len(leaves))[0] is None, "without a gradient in the forward pass"


def test_refuses_what_makes_no_sense(device, backend):
    arguments = network(device)
    parameters, inputs = parameters_of(arguments), [arguments["positions"], arguments["directions"]]
    cells, index = Cells(centres=arguments["centres"]), arguments["direction_index"]
    k = [parameter.detach() for parameter in parameters]

    def fwd(parameters=k, program=PROGRAM, inputs=inputs, cells=cells, ray_index=index):
        Network(program, parameters).fwd(inputs, cells, ray_index=ray_index)

    other, places = torch.ones(2, 3, 10, device=device), ("cells", "centres", "rows", "frozen", "k")
    wrong = {
        "program must be a Program, got str": {"program": "x"},
        "parameters must have 4 tensors, got 1": {"parameters": k[:1]},
        "parameters must be a list, got Tensor": {"parameters": k[0]},
        "inputs must be a list, got Tensor": {"inputs": inputs[0]},
        "ray_index must be given for a program with inputs of rays, got None": {"ray_index": None},
        "parameters[1] must have shape [k, 3, 10] with k = 3, got [2, 3, 10]": {"parameters": [k[0], other, *k[2:]]},
        "parameters[0] must be a tensor, got str": {"parameters": ["x", *k[1:]]},
        "k must be at least 1, got 0": {"cells": Cells(k=0)},
        "order must come with offsets, got no offsets": {"cells": Cells(order=index)},
        **{
            f"{name} must be None where offsets are given, got both": {
                "cells": Cells(**{"offsets": index, name: index})
            }
            for name in places
        },
        "program must have outputs [n, w], and inputs[0] with one row for each sample": {
            "program": replace(PROGRAM, sums=((3,),))
        },
    }
    for message, changed in wrong.items():
        with refused(TypeError if "must be a " in message else ValueError, f"Network: {message}"):
            fwd(**changed)
    raw, tape = forward(arguments, backend)
    loss, gradient = squares(raw)
    with refused(ValueError, "learn: loss must have shape [], got [40, 3]"):
        tape.learn(gradient, [gradient])
    with refused(ValueError, "learn: gradients[0] must have shape [40, 3], got [3]"):
        tape.learn(loss, [gradient[0]])
    with refused(TypeError, "learn: loss must be a tensor, got float"):
        tape.learn(0.0, [gradient])
    with refused(TypeError, "learn: defer must be True or False, got int"):
        tape.learn(loss, [gradient], defer=1)
    assert all(parameter.grad is None for parameter in parameters)


@pytest.mark.native
def test_the_dtype_of_the_parameters_decides_who_runs():
    arguments = network("cpu")
    wide = {name: arguments[name].double() for name in ("positions", "directions")}
    torch.testing.assert_close(forward({**arguments, **wide}, "native")[0], forward(arguments)[0])
    exact = {"weights": [w.detach().double() for w in arguments["weights"]]}
    exact |= {"biases": [arguments["biases"][0].detach().double(), None]}
    exact = {**arguments, **exact, "features": arguments["features"].detach().double()}
    assert torch.equal(forward(exact)[0], forward(exact, "reference")[0])
    with pytest.raises(BackendUnavailable, match=r"grouped_program takes .* not float64"):
        forward(exact, "native")
