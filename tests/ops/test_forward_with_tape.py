"""Networks that learn from the gradient of a loss to their outputs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from op_cases import refused

from voronerf import MLP, HashGrid, Layer
from voronerf.ops import forward_with_tape, routed_mlp
from voronerf.ops._core.backends import BackendUnavailable
from voronerf.ops._core.program import Builder

pytestmark = pytest.mark.op("forward_with_tape")

GRID = HashGrid(levels=2, features=2, log2_entries=10, finest=20)
TABLE = MLP(
    (Layer(("positions",), 8, "relu"), Layer((0, "directions"), 3)),
    outputs=(1,),
    position_encoding="hash",
    grid=GRID,
)


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


def as_program(arguments):
    """Returns the arguments of the same network as a program."""
    names = ("weights", "biases", "layers", "positions", "directions", "direction_index", "features")
    places = {name: value for name, value in arguments.items() if name not in names}
    return {
        "program": TABLE.program(3, 2, None, (True, False), ray=True),
        "inputs": [arguments["positions"], arguments["directions"]],
        "parameters": parameters_of(arguments),
        "ray_index": arguments["direction_index"],
        **places,
    }


def parameters_of(arguments):
    return [*arguments["weights"], arguments["biases"][0], arguments["features"]]


def squares(out):
    """Returns a loss that weights the rows differently, and its gradient."""
    factor = torch.linspace(0.5, 2, max(len(out), 1), device=out.device)[: len(out), None]
    return (factor * out.square()).sum(), 2 * factor * out


def learn(arguments, *, backward=False, backend="auto"):
    """Returns the loss; with ``backward`` its gradients are added immediately instead of deferred."""
    tape = forward_with_tape(as_program(arguments), backend=backend)
    assert not tape.raw.requires_grad
    return tape.backward(*squares(tape.raw), defer=not backward)


def composed(arguments):
    """Returns the same loss, differentiated by torch."""
    out, _ = routed_mlp(**arguments, backend="reference")
    return squares(out)[0]


@pytest.mark.parametrize(("n", "k"), [(0, 3), (1, 1), (40, 1), (40, 3)])
@pytest.mark.parametrize("backward", [False, True])
def test_equals_its_parts(device, backend, n, k, backward):
    arguments, expected = network(device, n, k), network(device, n, k)
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
    network = {"program": program, "inputs": [torch.randn(5, 3, device=device)], "parameters": weights}
    tape = forward_with_tape(network, backend=backend)
    tape.backward(*squares(tape.raw))
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
    arguments, expected = {**network("cpu", k=k), **more}, {**network("cpu", k=k), **more}
    loss = learn(arguments, backend=backend)
    loss.backward()
    wanted = composed(expected)
    wanted.backward()
    torch.testing.assert_close(loss.detach(), wanted.detach(), rtol=1e-4, atol=1e-5)
    for actual, other in zip(parameters_of(arguments), parameters_of(expected), strict=True):
        torch.testing.assert_close(actual.grad, other.grad, rtol=1e-4, atol=1e-4)


def test_is_once_differentiable(device, backend):
    arguments = network(device)
    loss = learn(arguments, backend=backend)
    with pytest.raises(RuntimeError):
        gradients = torch.autograd.grad(loss, parameters_of(arguments), create_graph=True)
        torch.autograd.grad(sum(gradient.square().sum() for gradient in gradients), arguments["weights"][0])


def test_refuses_a_program_that_makes_no_sense(backend):
    arguments = as_program(network("cpu"))
    wrong = {
        "network must hold program, inputs and parameters, got no inputs": {"inputs": ...},
        "program must be a Program, got str": {"program": "x"},
        "unknown arguments layers": {"layers": TABLE},
        "parameters must have 4 tensors, got 1": {"parameters": arguments["parameters"][:1]},
        "parameters[1] must have shape [k, 3, 10] with k = 3, got [2, 3, 10]": {
            "parameters": [arguments["parameters"][0], torch.ones(2, 3, 10), *arguments["parameters"][2:]]
        },
        "ray_index must be given for a program with inputs of rays, got None": {"ray_index": None},
        "frozen must have shape [k] with k = 3, got [2]": {"frozen": torch.zeros(2, dtype=torch.bool)},
        "program must have one output [n, w], and inputs[0] with one row for each sample": {
            "program": replace(arguments["program"], outputs=2 * arguments["program"].outputs)
        },
    }
    for message, change in wrong.items():
        network_ = {name: value for name, value in {**arguments, **change}.items() if value is not ...}
        error = TypeError if "must be a" in message or "unknown" in message else ValueError
        with refused(error, f"forward_with_tape: {message}"):
            forward_with_tape(network_, backend=backend)


def test_refuses_what_makes_no_sense(device, backend):
    arguments = network(device)
    with refused(ValueError, "forward_with_tape: network must hold program, inputs and parameters, got no program"):
        forward_with_tape({"inputs": [arguments["positions"]], "parameters": []})
    tape = forward_with_tape(as_program(arguments), backend=backend)
    loss, gradient = squares(tape.raw)
    with refused(ValueError, "forward_with_tape: loss must have shape [], got [40, 3]"):
        tape.backward(gradient, gradient)
    with refused(ValueError, "forward_with_tape: gradient must have shape [40, 3], got [3]"):
        tape.backward(loss, gradient[0])
    with refused(TypeError, "forward_with_tape: loss must be a tensor, got float"):
        tape.backward(0.0, gradient)
    with refused(TypeError, "forward_with_tape: defer must be True or False, got int"):
        tape.backward(loss, gradient, defer=1)
    assert all(parameter.grad is None for parameter in parameters_of(arguments))


@pytest.mark.parametrize(
    ("error", "message", "change"),
    [
        (ValueError, "network must hold program, inputs and parameters, got no program", {"program": ...}),
        (TypeError, "inputs must be a list, got Tensor", {"inputs": torch.ones(3)}),
        (TypeError, "unknown arguments op", {"op": 1}),
        (TypeError, "unknown arguments where", {"where": 1}),
        (TypeError, "network must hold arguments by name, got ...", {3: 1}),
    ],
)
def test_a_network_of_other_entries_is_refused(error, message, change, backend):
    arguments = {name: value for name, value in {**as_program(network("cpu")), **change}.items() if value is not ...}
    with refused(error, f"forward_with_tape: {message}"):
        forward_with_tape(arguments, backend=backend)


@pytest.mark.native
def test_the_dtype_of_the_parameters_decides_who_runs():
    arguments = as_program(network("cpu"))
    wide = {**arguments, "inputs": [x.double() for x in arguments["inputs"]]}
    torch.testing.assert_close(forward_with_tape(wide, backend="native").raw, forward_with_tape(arguments).raw)
    exact = {**arguments, "parameters": [p.detach().double() for p in arguments["parameters"]]}
    assert torch.equal(forward_with_tape(exact).raw, forward_with_tape(exact, backend="reference").raw)
    with pytest.raises(BackendUnavailable, match=r"forward_with_tape takes .* not float64"):
        forward_with_tape(exact, backend="native")
