"""What holds for every op: it compiles whole for any size, takes any strides and sizes, refuses what it must, and its
custom ops are registered well.

A row is a kind of an op's case (``voronerf/ops/<op>/case.py``). What is particular to an op, such as its formula, is in
its own file.
"""

from __future__ import annotations

import contextlib
import functools
import re
from collections import Counter
from unittest import mock

import pytest
import torch
from helpers import on_any_number_of_threads
from op_cases import need, refused, strided
from tolerances import assert_as_exact
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._pytree import tree_leaves, tree_map_only

from voronerf import ops
from voronerf.ops._core import backends, checks
from voronerf.ops._core.cases import Draw, cases
from voronerf.ops._core.declare import declared

CASES = cases()
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
NETWORKS = ("grouped_mlp", "grouped_program", "forward_with_tape", "routed_mlp", "routed_program", "adam", "average")
NETWORKS += ("hash_encode",)
"""Ops whose arguments tell how many tensors there are, and of which shapes."""
SINGLE = ("balance_centres", "cell_sort", "march_rays", "pixel_rays")
"""Ops without floating-point numbers, or with those of one size alone."""


def rows(runs):
    """A test of a name, a backend and a device."""
    ids = ["-".join(getattr(run, "values", run)) for run in runs]
    return pytest.mark.parametrize(("name", "backend", "device"), runs, indirect=["device"], ids=ids)


every_op = rows(RUNS)
# Each op compiles in its first kind; opcheck traces the custom ops of the others.
first_kinds = rows(
    [
        run if run[1] == "native" else pytest.param(*run, marks=pytest.mark.slow)
        for run in RUNS
        if run[0].partition(", ")[2] == next(iter(CASES[run[0].partition(",")[0]].kinds))
    ]
)
SMOOTH = [run for run in RUNS if CASES[run[0].partition(",")[0]].differentiable]
smooth_op = rows(SMOOTH)
natively = dict.fromkeys(name for name, backend, _ in RUNS if backend == "native")
native_op = pytest.mark.parametrize("name", list(natively))


def prepare(name, backend, device, dtype=torch.float32):
    """The op as a function of its tensors, and a maker of those by their number."""
    op, _, kind = name.partition(", ")
    case = CASES[op]
    need(op, backend, device, torch.int32 if op == "cell_sort" else torch.float32)
    rest = {}

    def ready(tensor):
        return tensor.to(device).detach().requires_grad_(tensor.is_floating_point())

    def make(n):
        given = tree_map_only(Tensor, ready, case.make(Draw(n, dtype=dtype, **case.kinds[kind]), n))
        rest.update({name: value for name, value in given.items() if not holds_tensors(value)})
        return {name: value for name, value in given.items() if holds_tensors(value)}

    def run(given, backend=backend):
        return getattr(ops, case.call or op)(**given, **rest, backend=backend)

    return run, make


def holds_tensors(value):
    return any(isinstance(leaf, Tensor) for leaf in tree_leaves(value))


def results(run, given):
    """What an op gives, and the gradients of its outputs if it has any."""
    found = [part for part in tree_leaves(run(given)) if isinstance(part, Tensor)]
    leaves = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor) and leaf.requires_grad]
    smooth = [part for part in found if part.requires_grad]
    if smooth:
        total = sum(part.square().sum() for part in smooth)
        found += torch.autograd.grad(total, leaves, allow_unused=True, materialize_grads=True)
    return found


def assert_close(found, expected):
    for part, other in zip(found, expected, strict=True):
        torch.testing.assert_close(part, other, rtol=1e-4, atol=1e-5)


@pytest.mark.slow
@first_kinds
def test_compiles_for_any_size(device, backend, name):
    torch.compiler.reset()
    run, tensors = prepare(name, backend, device)
    # The reference consists of torch's own operations, whose gradients are torch's to trace.
    backend = "eager" if backend == "reference" else "aot_eager"
    compiled = torch.compile(run, fullgraph=True, dynamic=True, backend=backend)  # one graph for any size
    for n in (9, 14):
        given = tensors(n)
        assert_close(results(compiled, given), results(run, given))


def columns(tensor):
    """The same values, column by column in memory where there are any."""
    return tensor.mT.contiguous().mT if tensor.dim() > 1 else tensor


def negated(tensor):
    """The same values in a view with the negative bit, as ``.conj().imag`` gives; memory holds them negated."""
    return torch._neg_view(-tensor) if tensor.is_floating_point() else tensor


@every_op
def test_any_view(device, backend, name):
    """Values count, and not how memory holds them."""
    run, tensors = prepare(name, backend, device)
    given = tensors(33)
    expected = results(run, given)
    for form in (strided, columns, negated):
        spread = lambda tensor, form=form: form(tensor.detach()).requires_grad_(tensor.requires_grad)  # noqa: E731
        assert_close(results(run, tree_map_only(Tensor, spread, given)), expected)


@every_op
def test_any_size_gives_what_the_reference_gives(device, backend, name):
    """Both kinds of rounding are allowed for: tests of each op compare with float64."""
    if backend == "reference":
        pytest.skip("is what the others are compared with")
    run, tensors = prepare(name, backend, device)
    for n in (0, 1, 2, 15, 16, 17, 33, 257):
        given = tensors(n)
        expected = results(functools.partial(run, backend="reference"), given)
        assert_close(results(run, given), expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64], ids=str)
@rows([run for run in RUNS if run[1] != "reference" and run[0].partition(",")[0] not in SINGLE])
def test_dtypes(device, backend, name, dtype):
    """Values and gradients have the dtypes of the reference's, and are as close to those of float64."""
    need(name.partition(", ")[0], backend, device, dtype)
    run, tensors = prepare(name, backend, device, dtype)
    given = tensors(65)
    wide = tree_map_only(Tensor, lambda tensor: tensor.double() if tensor.is_floating_point() else tensor, given)
    plain, exact = (results(functools.partial(run, backend="reference"), inputs) for inputs in (given, wide))
    for part, same, right in zip(results(run, given), plain, exact, strict=True):
        assert_as_exact(part, same, right) if same.is_floating_point() else torch.testing.assert_close(part, right)


@pytest.mark.parametrize(
    "name", dict.fromkeys(run[0] for run in RUNS if CASES[run[0].partition(",")[0]].differentiable)
)
def test_gradcheck(name):
    """Both derivatives of the reference in float64, along random directions."""
    run, tensors = prepare(name, "reference", torch.device("cpu"), torch.float64)
    wide = lambda tensor: tensor.detach().double().requires_grad_() if tensor.is_floating_point() else tensor  # noqa: E731
    given = tree_map_only(Tensor, wide, tensors(3))
    leaves = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor) and leaf.requires_grad]
    if name.partition(",")[0] == "render_loss":
        leaves = [given["raw"]]

    def call(*values):
        new = dict(zip(map(id, leaves), values))
        found = run(tree_map_only(Tensor, lambda tensor: new.get(id(tensor), tensor), given))
        return tuple(part for part in tree_leaves(found) if isinstance(part, Tensor) and part.requires_grad)

    assert torch.autograd.gradcheck(call, leaves, fast_mode=True)
    assert torch.autograd.gradgradcheck(call, leaves, fast_mode=True)


@rows([run for run in RUNS if run[0] in ("composite", "grouped_linear", "grouped_mlp", "routed_mlp")])
def test_autocast(device, backend, name):
    """Networks run in bfloat16, sums of rays in float32; gradients have the dtypes of what they are of."""
    run, tensors = prepare(name, backend, device)
    given = tensors(33)
    with torch.autocast(device.type, torch.bfloat16):
        found = results(run, given)
    expected = results(run, given)
    assert found[0].dtype == (torch.float32 if name == "composite" else torch.bfloat16)
    assert all(part.dtype == other.dtype for part, other in zip(found[-2:], expected[-2:]))
    torch.testing.assert_close(
        found[0].float(), expected[0], **({} if name == "composite" else {"rtol": 0.1, "atol": 0.1})
    )


@smooth_op
def test_only_the_gradients_asked_for(device, backend, name):
    """Each alone is what it is among all, also of a gradient that arrives expanded."""
    run, tensors = prepare(name, backend, device)
    given = tensors(33)
    leaves = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor) and leaf.requires_grad]
    options = {"allow_unused": True, "materialize_grads": True}

    def outputs():
        return [part for part in tree_leaves(run(given)) if isinstance(part, Tensor) and part.requires_grad]

    smooth = outputs()
    full = torch.autograd.grad(smooth, leaves, [torch.ones_like(part) for part in smooth], **options)
    for chosen, expected in zip(leaves, full):
        for leaf in leaves:
            leaf.requires_grad_(leaf is chosen)
        smooth = outputs()
        if smooth:
            found = torch.autograd.grad([part.sum() for part in smooth], chosen, **options)
            assert_close(found, [expected])
        else:
            assert not expected.any()
    for leaf in leaves:
        leaf.requires_grad_()
    with torch.no_grad():
        assert not outputs()


@pytest.mark.native
@native_op
def test_same_bits_for_any_number_of_threads(isa, name):
    run, tensors = prepare(name, "native", torch.device("cpu"))
    given = tensors(3000)
    on_any_number_of_threads(lambda: [part.nan_to_num(7) for part in results(run, given)])


@pytest.mark.native
@native_op
def test_every_output_is_written(request, name):
    """Memory comes with what it held, which must not show, and between guards that must survive."""
    run, tensors = prepare(name, "native", torch.device("cpu"))
    wanted = [results(run, tensors(n)) for n in (0, 1, 33, 70)]
    guards = request.getfixturevalue("poisoned")
    for n, expected in zip((0, 1, 33, 70), wanted):
        for found, right in zip(results(run, tensors(n)), expected, strict=True):
            torch.testing.assert_close(found, right, rtol=0, atol=0, equal_nan=True)
    assert len(guards) >= 8


OF_NETWORKS = ("adam", "average", "forward_with_tape", "render_opaque")
"""Ops whose arguments no custom op could have, lists of rules and networks."""


@pytest.mark.parametrize(
    "name", [op for op, case in CASES.items() if (case.in_place or not case.traced) and op not in OF_NETWORKS]
)
def test_what_only_steps_call_compiles(name):
    """As a custom op, which says what it writes into."""
    torch.compiler.reset()
    case = CASES[name]

    def run(given):
        found = getattr(ops, case.call or name)(**given, backend="native")
        return found, {key: value for key, value in given.items() if isinstance(value, Tensor)}

    kind = [*case.kinds.values()][-1]
    expected, found, again = (case.make(Draw(**kind), 6) for _ in range(3))
    with torch._dynamo.config.patch(capture_dynamic_output_shape_ops=True):
        found = torch.compile(run, fullgraph=True, backend="aot_eager")(found)
    torch.testing.assert_close(found, run(expected), equal_nan=True)
    with Calls() as calls:
        run(again)
    (called,) = calls.found.values()
    torch.library.opcheck(*called)


class Calls(TorchFunctionMode):
    """Notes the custom ops of the library that are called, and once for each kind of arguments what with."""

    def __init__(self):
        super().__init__()
        self.found = {}

    def __torch_function__(self, function, types, args=(), kwargs=None):
        if isinstance(function, torch._ops.OpOverload) and function.namespace == "voronerf":
            # An op that is called where nothing is recorded need not be differentiable.
            held = args if torch.is_grad_enabled() else tree_map_only(Tensor, Tensor.detach, args)
            kinds = [leaf.requires_grad if isinstance(leaf, Tensor) else leaf is None for leaf in tree_leaves(held)]
            self.found[function, str(kinds)] = (function, held)
        return function(*args, **(kwargs or {}))


@every_op
def test_custom_ops_pass_opcheck(device, backend, name):
    """Those that its values call, its gradients, and its second derivatives."""
    if backend == "reference":
        pytest.skip("has none")
    run, tensors = prepare(name, backend, device)
    given = tensors(6)
    leaves = [leaf for leaf in tree_leaves(given) if isinstance(leaf, Tensor) and leaf.requires_grad]
    with Calls() as calls:
        results(run, given)
        for power in (1, 2):  # in a plain sum the gradients that arrive are constant
            smooth = [part for part in tree_leaves(run(given)) if isinstance(part, Tensor) and part.requires_grad]
            if smooth:
                total = sum(part.pow(power).sum() for part in smooth)
                options = {"create_graph": True, "allow_unused": True, "materialize_grads": True}
                bent = [first for first in torch.autograd.grad(total, leaves, **options) if first.requires_grad]
                torch.autograd.backward([first.square().sum() for first in bent])
    assert calls.found or (backend == "warp" and name.startswith("grouped_program"))  # which are no chains
    for function, args in calls.found.values():
        torch.library.opcheck(function, args)


@pytest.mark.parametrize(("op", "message"), [(op, message) for op, case in CASES.items() for message in case.refused])
def test_refuses(op, message):
    case = CASES[op]
    name, given = case.call or op, case.make(Draw(), 6)
    getattr(ops, name)(**given)
    kinds = "an integer|an MLP|OwnSamples|True|a (number|tensor|list|function|HashGrid)"
    of_types = re.search(f"dtype|must be ({kinds})", message)
    with refused(TypeError if of_types else ValueError, f"{name}: {message}"):
        getattr(ops, name)(**{**given, **case.refused[message]})


@pytest.mark.parametrize("backend", ["reference", "native"])
@pytest.mark.parametrize("op", CASES)
def test_refuses_offsets_that_are_no_offsets(op, backend):
    case = CASES[op]
    for kind in case.kinds.values() if backend in backends.implemented(op) else ():
        given = case.make(Draw(**kind), 6)
        for name in given.keys() & {"offsets", "ray_offsets"}:
            last = len(given[name]) - 1
            for place, wrong in ((0, -1), (last // 2, int(given[name][-1]) + 1), (last, 1000)):
                bad = given[name].clone()
                bad[place] = wrong
                with pytest.raises(ValueError, match=rf"^\S+: {name} must rise[ ,].* number of .*, got "):
                    getattr(ops, case.call or op)(**{**given, name: bad}, backend=backend)


def shapes_of(name, call, given):
    """The shapes that a call checks, by the names of its tensors, and how often it speaks of each letter."""
    shapes, letters = {}, Counter()

    def tensor(self, key, value, dtypes, *shape):
        if self.op == name:
            letters.update(self.sizes.keys() - known)  # a size that is no tensor's, such as a number of samples
        whole(self, key, value, dtypes, *shape)
        if self.op == name:
            shapes[key] = [str(entry).removesuffix("+1") for entry in shape]
            letters.update(shapes[key])
            known.update(self.sizes)

    known, whole = set(), checks.Checked.tensor
    with mock.patch.object(checks.Checked, "tensor", tensor), in_python(name):
        call(**given)
    return shapes, letters


@contextlib.contextmanager
def in_python(name):
    """The arguments of an op are checked in Python, not in the compiled module."""
    if name in NETWORKS:
        yield
        return
    with mock.patch.object(declared(name), "_calls", lambda args, options: NotImplemented):
        yield


@pytest.mark.native
@pytest.mark.parametrize("op", [op for op in CASES if op not in NETWORKS])
def test_the_compiled_module_checks_what_python_checks(op):
    """It takes all valid arguments; what it does not take Python refuses, in `test_refuses_tensors_that_do_not_fit`."""
    case = CASES[op]
    call, name = getattr(ops, case.call or op), case.call or op
    for kind in case.kinds.values():
        with mock.patch.object(declared(name), "_call", side_effect=AssertionError):
            call(**case.make(Draw(**kind), 6))


@pytest.mark.parametrize("op", CASES)
def test_refuses_tensors_that_do_not_fit(op):
    """Anything but a tensor, other numbers of rows and columns, dtypes and devices, by the name of the argument."""
    case = CASES[op]
    call, name = getattr(ops, case.call or op), case.call or op
    for kind in case.kinds.values():
        given = case.make(Draw(**kind), 6)
        tensors = {key: value for key, value in given.items() if isinstance(value, Tensor)}
        shapes, letters = shapes_of(name, call, given)
        assert op in NETWORKS or tensors.keys() <= shapes.keys()
        for key, tensor in tensors.items():
            with pytest.raises(TypeError, match=rf"^{name}: {key} must be a tensor, got str$"):
                call(**{**given, key: "x"})
            other = tensor.long() if tensor.dtype == torch.int32 else tensor.to(torch.int8)
            with pytest.raises(TypeError, match=rf"^{name}: \S+ must have (the )?dtype .*, got "):
                call(**{**given, key: other})
            wrong = [tensor[None]]
            for place, entry in enumerate(shapes.get(key, [])):
                if entry.isdigit() or letters[entry] > 1:
                    wrong.append(tensor.narrow(place, 0, tensor.shape[place] - 1))
            for part in wrong:
                with pytest.raises(ValueError, match=rf"^{name}: \S+ must have shape \[.*, got "):
                    call(**{**given, key: part})
            if len(tensors) > 1:
                with pytest.raises(ValueError, match=rf"^{name}: \S+ must (be on the device of|have values)"):
                    call(**{**given, key: tensor.to("meta")})
