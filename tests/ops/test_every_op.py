"""Rules for every op: it compiles to one graph for any size, takes any strides and sizes, refuses wrong arguments, and
its custom ops pass opcheck.

Each kind of arguments in an op's case (``cases/<op>.py``) is a test. The test file of an op tests rules of this op
alone, such as its formula.
"""

from __future__ import annotations

import functools
import itertools
import re
from collections import Counter
from contextlib import contextmanager
from unittest import mock

import pytest
import torch
from cases import CASES, Draw
from helpers import on_any_number_of_threads
from op_cases import FLOATS, need, refused, strided
from tolerances import assert_as_exact
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map_only

from voronerf import ops
from voronerf.ops._core import backends
from voronerf.ops._core.declare import declared

KINDS = [
    (op, kind)
    for op, case in CASES.items()
    if case.comparable and case.traced and not case.in_place
    for kind in case.kinds
]
RUNS = [
    (f"{op}, {kind}" if kind else op, backend, device)
    for op, kind in KINDS
    for backend in backends.implemented(op)
    for device in ("cpu", "cuda")
]
NETWORKS = ("grouped_mlp", "grouped_program", "routed_mlp", "routed_program", "adam", "average", "hash_encode")
"""The ops that take tensors whose number or shapes depend on an argument that is no tensor, such as a program."""
SINGLE = ("balance_centres", "cell_sort", "march_rays", "pixel_rays")
"""The ops without floating-point tensors, or with a single floating-point dtype."""


def rows(runs):
    """Returns a parametrization over op names, backends and devices."""
    ids = ["-".join(getattr(run, "values", run)) for run in runs]
    return pytest.mark.parametrize(("name", "backend", "device"), runs, indirect=["device"], ids=ids)


FIRST = [run for run in RUNS if run[0].partition(", ")[2] == next(iter(CASES[run[0].partition(",")[0]].kinds))]
# The compile test covers the first kind of each op; opcheck traces the custom ops for the other kinds. Schemas and fake
# results are the same for all backends.
first_kinds = rows([run if run[1] == "native" else pytest.param(*run, marks=pytest.mark.slow) for run in FIRST])
# All networks are calls of one custom op. One network has an index of centres, as no other case has.
LAYERS = ("grouped_linear", "grouped_mlp", "routed_mlp", "routed_program")
CHECKED = [run for run in RUNS if run[0].partition(",")[0] not in LAYERS or run[0] == "routed_program, by an index"]
custom_ops = rows([run for run in CHECKED if run[1] == "native" or (run[1] == "warp" and run in FIRST)])
SMOOTH = [run for run in RUNS if CASES[run[0].partition(",")[0]].differentiable]
native_op = pytest.mark.parametrize("name", dict.fromkeys(name for name, backend, _ in RUNS if backend == "native"))


def prepare(name, backend, device, dtype=torch.float32):
    """Returns the op as a function of its tensors, and a function that makes these tensors with n rows."""
    op, _, kind = name.partition(", ")
    case = CASES[op]
    need(op, backend, device, torch.int32 if op == "cell_sort" else torch.float32)
    rest = {}

    def ready(tensor):
        return tensor.to(device).detach().requires_grad_(tensor.is_floating_point())

    def make(n):
        arguments = tree_map_only(Tensor, ready, case.make(Draw(n, dtype=dtype, **case.kinds[kind]), n))
        rest.update({name: value for name, value in arguments.items() if not holds_tensors(value)})
        return {name: value for name, value in arguments.items() if holds_tensors(value)}

    def run(arguments, backend=backend):
        return getattr(ops, case.call or op)(**arguments, **rest, backend=backend)

    return run, make


def holds_tensors(value):
    return any(isinstance(leaf, Tensor) for leaf in tree_leaves(value))


def results(run, arguments):
    """Returns the outputs of an op, and the gradients of the sum of their squares if some are differentiable."""
    tensors = [part for part in tree_leaves(run(arguments)) if isinstance(part, Tensor)]
    leaves = [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor) and leaf.requires_grad]
    smooth = [part for part in tensors if part.requires_grad]
    if smooth:
        total = sum(part.square().sum() for part in smooth)
        tensors += torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
    return tensors


def assert_close(actual, expected):
    for part, other in zip(actual, expected, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@first_kinds
def test_compiles_for_any_size(device, backend, name):
    torch.compiler.reset()
    run, tensors = prepare(name, backend, device)
    # The reference consists of PyTorch operations, and PyTorch itself traces their gradients.
    backend = "eager" if backend == "reference" else "aot_eager"
    compiled = torch.compile(run, fullgraph=True, dynamic=True, backend=backend)  # one graph for any size
    for n in (9, 14):
        arguments = tensors(n)
        assert_close(results(compiled, arguments), results(run, arguments))


def columns(tensor):
    """Returns the same values in column-major order, if the tensor has columns."""
    return tensor.mT.contiguous().mT if tensor.dim() > 1 else tensor


def negated(tensor):
    """Returns a view with the negative bit, like ``.conj().imag``: memory holds the negated values."""
    return torch._neg_view(-tensor) if tensor.is_floating_point() else tensor


@rows(RUNS)
def test_any_view(device, backend, name):
    """Results depend on the values of the arguments, not on their memory layout."""
    run, tensors = prepare(name, backend, device)
    arguments = tensors(33)
    expected = results(run, arguments)
    for form in (strided, columns, negated):
        spread = lambda tensor, form=form: form(tensor.detach()).requires_grad_(tensor.requires_grad)  # noqa: E731
        assert_close(results(run, tree_map_only(Tensor, spread, arguments)), expected)


@rows([run for run in RUNS if run[1] != "reference"])
def test_any_size_gives_what_the_reference_gives(device, backend, name):
    """The tolerance allows for the rounding of both backends; :func:`test_dtypes` compares with float64."""
    run, tensors = prepare(name, backend, device)
    for n in (0, 1, 15, 16, 17, 33, 257):
        arguments = tensors(n)
        expected = results(functools.partial(run, backend="reference"), arguments)
        assert_close(results(run, arguments), expected)


@pytest.mark.parametrize("dtype", FLOATS, ids=str)
@rows([run for run in RUNS if run[1] != "reference" and run[0].partition(",")[0] not in SINGLE])
def test_dtypes(device, backend, name, dtype):
    """Values and gradients have the reference's dtypes, and are as close to the float64 results as the reference's."""
    need(name.partition(", ")[0], backend, device, dtype)
    run, tensors = prepare(name, backend, device, dtype)
    arguments = tensors(65)
    wide = tree_map_only(Tensor, lambda tensor: tensor.double() if tensor.is_floating_point() else tensor, arguments)
    plain, exact = (results(functools.partial(run, backend="reference"), inputs) for inputs in (arguments, wide))
    for part, same, right in zip(results(run, arguments), plain, exact, strict=True):
        assert_as_exact(part, same, right) if same.is_floating_point() else torch.testing.assert_close(part, right)


# The kinds of routed networks differ in how they find the cells, not in their gradients.
@pytest.mark.parametrize(
    "name", dict.fromkeys(run[0] for run in SMOOTH if run in FIRST or not run[0].startswith("routed"))
)
def test_gradcheck(name):
    """First and second derivatives of the reference pass gradcheck in float64, along random directions."""
    run, tensors = prepare(name, "reference", torch.device("cpu"), torch.float64)
    wide = lambda tensor: tensor.detach().double().requires_grad_() if tensor.is_floating_point() else tensor  # noqa: E731
    arguments = tree_map_only(Tensor, wide, tensors(3))
    leaves = [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor) and leaf.requires_grad]

    def call(*values):
        new = dict(zip(map(id, leaves), values))
        result = run(tree_map_only(Tensor, lambda tensor: new.get(id(tensor), tensor), arguments))
        return tuple(part for part in tree_leaves(result) if isinstance(part, Tensor) and part.requires_grad)

    assert torch.autograd.gradcheck(call, leaves, fast_mode=True)
    assert torch.autograd.gradgradcheck(call, leaves, fast_mode=True)


@rows([run for run in RUNS if run[0] in ("composite", "grouped_linear", "grouped_mlp", "routed_mlp")])
def test_autocast(device, backend, name):
    """Networks run in bfloat16, sums over rays in float32; each gradient has the dtype of its tensor."""
    run, tensors = prepare(name, backend, device)
    arguments = tensors(33)
    with torch.autocast(device.type, torch.bfloat16):
        actual = results(run, arguments)
    expected = results(run, arguments)
    assert actual[0].dtype == (torch.float32 if name == "composite" else torch.bfloat16)
    assert all(part.dtype == other.dtype for part, other in zip(actual[-2:], expected[-2:]))
    torch.testing.assert_close(
        actual[0].float(), expected[0], **({} if name == "composite" else {"rtol": 0.1, "atol": 0.1})
    )


@rows([run for run in SMOOTH if run[1] != "reference"])
def test_only_the_gradients_asked_for(device, backend, name):
    """A gradient computed alone, from an expanded incoming gradient, equals the gradient computed with all others."""
    run, tensors = prepare(name, backend, device)
    arguments = tensors(33)
    leaves = [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor) and leaf.requires_grad]
    options = {"allow_unused": True, "materialize_grads": True}

    def outputs():
        return [part for part in tree_leaves(run(arguments)) if isinstance(part, Tensor) and part.requires_grad]

    smooth = outputs()
    full = torch.autograd.grad(smooth, leaves, [torch.ones_like(part) for part in smooth], **options)
    for chosen, expected in zip(leaves, full):
        for leaf in leaves:
            leaf.requires_grad_(leaf is chosen)
        smooth = outputs()
        if smooth:
            actual = torch.autograd.grad([part.sum() for part in smooth], chosen, **options)
            assert_close(actual, [expected])
        else:
            assert not expected.any()
    for leaf in leaves:
        leaf.requires_grad_()
    with torch.no_grad():
        assert not outputs()


BENT = ["grouped_linear", "grouped_mlp", "grouped_mlp, integrated", "routed_mlp", "grouped_program, encoded"]
BENT += ["frequency_encode", "integrated_encode", "spherical_harmonics", "composite, packed"]


@rows([run for run in SMOOTH if run[0] in BENT and run[1] != "reference"])
def test_a_loss_on_second_derivatives(device, backend, name):
    """The gradients of a loss on second derivatives, such as a curvature, need third derivatives of the op."""
    run, tensors = prepare(name, backend, device)
    arguments = tensors(9)
    wide = tree_map_only(Tensor, lambda tensor: tensor.double() if tensor.is_floating_point() else tensor, arguments)
    options = {"allow_unused": True, "materialize_grads": True}

    def gradients(arguments, **backend):
        leaves = [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor) and leaf.requires_grad]
        smooth = [part for part in tree_leaves(run(arguments, **backend)) if part.requires_grad]
        total = sum((part.flatten() * torch.linspace(-1, 1.5, part.numel()).to(part)).sum() for part in smooth)
        slopes = torch.autograd.grad(total, leaves, create_graph=True, **options)
        total = sum((slope * (1 + slope)).sum() for slope in slopes)
        bends = torch.autograd.grad(total, leaves, create_graph=True, **options)
        assert any(bend.requires_grad for bend in bends)
        return torch.autograd.grad(sum(part.square().mean() for part in (*smooth, *slopes, *bends)), leaves, **options)

    for actual, exact in zip(gradients(arguments), gradients(wide, backend="reference"), strict=True):
        torch.testing.assert_close(actual.double(), exact, rtol=2e-3, atol=2e-4 * float(exact.abs().max()))


@pytest.mark.native
@native_op
def test_same_bits_for_any_number_of_threads(isa, name):
    run, tensors = prepare(name, "native", torch.device("cpu"))
    arguments = tensors(3000)
    on_any_number_of_threads(lambda: [part.nan_to_num(7) for part in results(run, arguments)])


@pytest.mark.native
@native_op
def test_every_output_is_written(request, name):
    """No output keeps old contents of its memory, and the guard bytes around the memory are unchanged."""
    run, tensors = prepare(name, "native", torch.device("cpu"))
    wanted = [results(run, tensors(n)) for n in (0, 1, 33, 70)]
    guards = request.getfixturevalue("poisoned")
    for n, expected in zip((0, 1, 33, 70), wanted):
        for actual, right in zip(results(run, tensors(n)), expected, strict=True):
            torch.testing.assert_close(actual, right, rtol=0, atol=0, equal_nan=True)
    assert len(guards) >= 8


OF_NETWORKS = ("adam", "average", "render_opaque")
"""The ops that cannot be custom ops, since their arguments are lists of rules and networks."""


@pytest.mark.parametrize(
    "name", [op for op, case in CASES.items() if (case.in_place or not case.traced) and op not in OF_NETWORKS]
)
def test_what_only_steps_call_compiles(name):
    """The op compiles as a custom op that declares its mutated arguments."""
    torch.compiler.reset()
    case = CASES[name]

    def run(arguments):
        actual = getattr(ops, case.call or name)(**arguments, backend="native")
        return actual, {key: value for key, value in arguments.items() if isinstance(value, Tensor)}

    kind = [*case.kinds.values()][-1]
    expected, actual, again = (case.make(Draw(**kind), 6) for _ in range(3))
    with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True):
        actual = torch.compile(run, fullgraph=True, backend="aot_eager")(actual)
    torch.testing.assert_close(actual, run(expected), equal_nan=True)
    with Calls() as calls:
        run(again)
    (called,) = calls.found.values()
    torch.library.opcheck(*called)


class Calls(TorchFunctionMode):
    """A mode that collects calls of the library's custom ops: one call for each op and kind of arguments."""

    def __init__(self):
        super().__init__()
        self.found = {}

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if isinstance(function, torch._ops.OpOverload) and function.namespace == "voronerf":
            # Without recorded gradients a custom op need not be differentiable.
            held = args if torch.is_grad_enabled() else tree_map_only(Tensor, Tensor.detach, args)
            kinds = [leaf.requires_grad if isinstance(leaf, Tensor) else leaf is None for leaf in tree_leaves(held)]
            self.found[function, str(kinds)] = (function, held)
        return function(*args, **(kwargs or {}))


@custom_ops
def test_custom_ops_pass_opcheck(device, backend, name):
    """The custom ops for values, gradients and second derivatives pass opcheck."""
    run, tensors = prepare(name, backend, device)
    arguments = tensors(6)
    leaves = [leaf for leaf in tree_leaves(arguments) if isinstance(leaf, Tensor) and leaf.requires_grad]
    with Calls() as calls:
        results(run, arguments)
        for power in (1, 2):  # power 1: constant incoming gradients
            smooth = [part for part in tree_leaves(run(arguments)) if isinstance(part, Tensor) and part.requires_grad]
            if smooth:
                total = sum(part.pow(power).sum() for part in smooth)
                options = {"create_graph": True, "allow_unused": True, "materialize_grads": True}
                bent = [first for first in torch.autograd.grad(total, leaves, **options) if first.requires_grad]
                torch.autograd.backward([first.square().sum() for first in bent])
    assert calls.found
    for function, args in calls.found.values():
        torch.library.opcheck(function, args)


@pytest.mark.parametrize(("op", "message"), [(op, message) for op, case in CASES.items() for message in case.refused])
def test_refuses(op, message):
    case = CASES[op]
    name, arguments = case.call or op, case.make(Draw(), 6)
    getattr(ops, name)(**arguments)
    kinds = "an integer|an MLP|True|Cells|a (number|tensor|list|function|HashGrid|Network|Program)"
    of_types = re.search(f"dtype|must be ({kinds})", message)
    with refused(TypeError if of_types else ValueError, f"{name}: {message}"):
        getattr(ops, name)(**{**arguments, **case.refused[message]})


@pytest.mark.parametrize("backend", ["reference", "native"])
@pytest.mark.parametrize("op", CASES)
def test_refuses_offsets_that_are_no_offsets(op, backend):
    case = CASES[op]
    for kind in case.kinds.values() if backend in backends.implemented(op) else ():
        arguments = case.make(Draw(**kind), 6)
        for name in arguments.keys() & {"offsets", "ray_offsets"}:
            last = len(arguments[name]) - 1
            for place, wrong in ((0, -1), (last // 2, int(arguments[name][-1]) + 1), (last, 1000)):
                bad = arguments[name].clone()
                bad[place] = wrong
                with pytest.raises(ValueError, match=rf"^\S+: {name} must ascend within 0 to .* number of .*, got "):
                    getattr(ops, case.call or op)(**{**arguments, name: bad}, backend=backend)


def shapes_of(name, arguments):
    """Returns the shapes of an op's tensors by name, and the number of times that arguments mention each letter."""
    shapes, letters = {}, Counter()
    for each in () if name in NETWORKS else declared(name).arguments:
        value, rule = arguments.get(each.name), each.rule
        if each.kind is Tensor and value is not None:
            none = arguments.get(rule.condition) is None if rule.condition else value.dim() != len(rule.shape)
            shape = rule.otherwise if none and rule.otherwise else rule.shape
            shapes[each.name] = [str(entry).removesuffix("+1") for entry in shape]
            letters.update(shapes[each.name])
        letters[each.name] += each.kind is int  # a size that is an argument, such as a number of samples
    return shapes, letters


@contextmanager
def in_python(name):
    """Makes the op check its arguments as it does while torch's compiler traces."""
    owner = mock.Mock() if name in NETWORKS else declared(name)
    in_declared = mock.patch.object(owner, "_calls", lambda *_: NotImplemented)
    with mock.patch.object(backends, "compiled", lambda: None), in_declared:
        yield


@pytest.mark.native
@pytest.mark.parametrize("op", [op for op in CASES if op not in NETWORKS])
def test_the_compiler_sees_the_checks_of_the_compiled_module(op):
    """Checks in Python and in C++ refuse the same calls: each argument has each floating-point dtype in turn."""
    case, name = CASES[op], CASES[op].call or op
    call = getattr(ops, name)

    def error(arguments):
        try:
            call(**arguments)
        except (TypeError, ValueError) as refusal:
            return type(refusal)
        return None

    for kind, dtype in itertools.product(case.kinds.values(), FLOATS):
        arguments = case.make(Draw(**{**kind, "dtype": dtype}), 6)
        floats = [key for key, part in arguments.items() if isinstance(part, Tensor) and part.is_floating_point()]
        for key, other in itertools.product(floats, FLOATS):
            changed = {**arguments, key: arguments[key].to(other)}
            with in_python(name):
                expected = error(changed)
            assert error(changed) == expected, (key, dtype, other)


@pytest.mark.parametrize("op", CASES)
def test_refuses_tensors_that_do_not_fit(op):
    """An argument of a wrong type, shape, dtype or device is refused, and the error names it."""
    case = CASES[op]
    call, name = getattr(ops, case.call or op), case.call or op
    for kind in case.kinds.values():
        arguments = case.make(Draw(**kind), 6)
        tensors = {key: value for key, value in arguments.items() if isinstance(value, Tensor)}
        shapes, letters = shapes_of(name, arguments)
        assert op in NETWORKS or tensors.keys() <= shapes.keys()
        for key, tensor in tensors.items():
            other = tensor.long() if tensor.dtype == torch.int32 else tensor.to(torch.int8)
            wrong = [(TypeError, r"have (the )?dtype .*, got ", other)]
            shape = (ValueError, r"have shape \[.*, got ")
            if key != "features":  # a table [1, e, f] fits, too
                wrong.append((*shape, tensor[None]))
            for place, entry in enumerate(shapes.get(key, [])):
                if entry.isdigit() or letters[entry] > 1:
                    wrong.append((*shape, tensor.narrow(place, 0, tensor.shape[place] - 1)))
            if len(tensors) > 1:
                wrong.append((ValueError, "(be on the device of|have values)", tensor.to("meta")))
            with pytest.raises(TypeError, match=rf"^{name}: {key} must be a tensor, got str$"):
                call(**{**arguments, key: "x"})
            for error, rule, part in wrong:
                with pytest.raises(error, match=rf"^{name}: \S+ must {rule}"):
                    call(**{**arguments, key: part})
                with pytest.raises(error, match=rf"^{name}: \S+ must "), in_python(name):
                    call(**{**arguments, key: part})
