"""One declaration an op: the signature of its public function.

::

    @declare(native=Implementation(EVERYWHERE, COORDINATES))
    def nearest_centre(
        points: Annotated[Tensor, "floating [n, 3]"],
        centres: Annotated[Tensor, "floating [k, 3]"],
        *,
        backend: str = "auto",
    ) -> Annotated[Tensor, "int32 [n]"]:
        \"\"\"What it computes, which needs no body.\"\"\"

The decorator makes the function: it checks the arguments, chooses a backend, and calls its implementation with the
arguments one after another. From the same signature come the schema of custom ops, memory for their results (which is
their fake), their gradients (`Declaration.backward_op`), and the members of compiled structs (`Declaration.inputs` and
`Declaration.outputs`).

A tensor is written as its dtypes and its shape. The dtypes are ``floating``, names of some (``float32|float64``),
``same`` as the first floating-point tensor, or ``wide``, the same but at least float32. The shape has numbers, letters,
a letter plus one, and arguments that are integers. Of ``[3] or [r, 3]`` the first holds for a tensor of as many
dimensions, of ``[m] if ray_offsets else [r, s]`` where that argument is given. In the shape of a result an entry is
any expression of letters and arguments. An int is written as a range (``1..4``, ``0..``), a float as ``positive``, or
an interval (``[0, 1)``, ``0 to 1``), a str as its choices (``linear|disparity``). What is written by its class alone is
an instance of it.
"""

from __future__ import annotations

import collections
import functools
import inspect
import re
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from voronerf.ops._core import backends, checks
from voronerf.ops._core.backends import Implementation
from voronerf.ops._core.checks import FLOATING, LIKE_FIRST, MAX_COUNT
from voronerf.ops._core.custom_op import Op, Structs, make_op
from voronerf.ops._core.derivatives import register_derivatives

F = TypeVar("F", bound=Callable[..., Any])
Check = Callable[[checks.Checked, dict[str, Any]], None]
"""Checks one of the values of a call, by the names of its arguments."""
_DECLARED: dict[str, Declaration] = {}
_DTYPES = {"floating": FLOATING, "same": LIKE_FIRST, "wide": LIKE_FIRST}


def declare(
    *,
    native: Implementation | None = None,
    warp: Implementation | None = None,
    reference: Implementation | None = None,
    smooth: Sequence[str] = (),
    small: Sequence[str] = (),
    prepare: Callable[[Any], Any] | None = None,
    composed: bool = False,
) -> Callable[[F], F]:
    """Makes the public function of an op from its signature, and puts its row into the table of backends.

    Args:
        native: of csrc/.
        warp: of kernels/.
        reference: in plain PyTorch.
        smooth: the arguments that have gradients. The others are detached.
        small: the arguments whose elements an int32 must number.
        prepare: takes the checked arguments, as a named tuple, and gives those of the implementations; it checks what
            the signature cannot say.
        composed: whether the reference takes the ``backend`` of other ops that it calls (`resolve_composed`).
    """

    def of(function: F) -> F:
        name = backends.declare(function.__name__, native=native, warp=warp, reference=reference or Implementation())
        made: F = Declaration(name, function, smooth, small, prepare, composed).public(function)
        return made

    return of


def declared(name: str) -> Declaration:
    """The declaration of an op."""
    return _DECLARED[name]


class Shaped(NamedTuple):
    """A tensor of a signature."""

    dtypes: tuple[torch.dtype, ...]
    shape: tuple[int | str, ...]
    wide: bool = False
    condition: str = ""
    otherwise: tuple[int | str, ...] = ()

    @property
    def either(self) -> bool:
        """Whether it may have the one shape or the other."""
        return bool(self.otherwise) and not self.condition

    @staticmethod
    def parse(text: str) -> Shaped:
        """Of what a signature says."""
        found = re.fullmatch(r"([\w|]+) \[(.*?)\](?: (?:if (\w+) else|or) \[(.*)\])?", text)
        assert found is not None, f"a tensor is written as dtypes and a shape, got {text!r}"
        dtypes, shape, condition, otherwise = found.groups()
        known = _DTYPES.get(dtypes)
        if known is None:
            known = tuple(getattr(torch, name) for name in dtypes.split("|"))
        return Shaped(known, _entries(shape), dtypes == "wide", condition or "", _entries(otherwise or ""))


def _entries(text: str) -> tuple[int | str, ...]:
    parts = [part.strip() for part in text.split(",") if part.strip()]
    return tuple(int(part) if part.isdigit() else part for part in parts)


class Argument(NamedTuple):
    """An argument of a signature."""

    name: str
    kind: Any
    optional: bool
    rule: Any

    def check(self, op: str, detach: bool, bind: bool) -> Check:
        """What checks its value in a call, and puts it right.

        Args:
            op: Named in errors.
            detach: Whether it has no gradients.
            bind: Whether shapes speak of it.
        """
        name, kind, rule = self.name, self.kind, self.rule
        if kind is Tensor:
            return self._check_tensor(op, detach and (not rule.dtypes or bool({*rule.dtypes} & {*FLOATING})))
        if kind is int:

            def check(given: checks.Checked, values: dict[str, Any]) -> None:
                checks.check_integer(op, name, values[name], *rule)
                if bind:
                    given.sizes[name] = values[name]

        elif kind is float:

            def check(given: checks.Checked, values: dict[str, Any]) -> None:
                rule(op, name, values[name])
                values[name] = float(values[name])

        elif kind is bool:

            def check(given: checks.Checked, values: dict[str, Any]) -> None:
                checks.check_flag(op, name, values[name])

        elif kind is str:

            def check(given: checks.Checked, values: dict[str, Any]) -> None:
                checks.check_choice(op, name, values[name], rule)

        else:

            def check(given: checks.Checked, values: dict[str, Any]) -> None:
                if isinstance(kind, type):
                    checks.check_kind(op, name, values[name], kind)

        return check

    def _check_tensor(self, op: str, detach: bool) -> Check:
        name, (dtypes, first, wide, condition, second), either = self.name, self.rule, self.rule.either

        def check(given: checks.Checked, values: dict[str, Any]) -> None:
            tensor, shape = values[name], first
            if either:
                checks.check_tensor(op, name, tensor)
                shape = first if tensor.dim() == len(first) else second
            elif condition and values[condition] is None:
                shape = second
            own = [torch.promote_types(given.first_float().dtype, torch.float32)] if wide else dtypes
            given.tensor(name, tensor, own, *shape)
            if detach and tensor.requires_grad:
                values[name] = tensor.detach()

        return check


class Declaration:
    """What the signature of an op says.

    Attributes:
        name: of the op.
        arguments: one after another, without ``backend``.
        results: tensors, by their names.
        allocate: memory for the results, from the named tuple.
        Inputs: the arguments as a named tuple, which has the letters of their shapes as attributes.
    """

    def __init__(
        self,
        name: str,
        function: Callable[..., Any],
        smooth: Sequence[str],
        small: Sequence[str],
        prepare: Callable[[Any], Any] | None,
        composed: bool,
    ) -> None:
        self.name, self.smooth, self._small, self._prepare = name, smooth, small, prepare
        self._resolve = backends.resolve_composed if composed else backends.resolve
        hints = typing.get_type_hints(function, include_extras=True)
        of_result = hints.pop("return")
        hints.pop("backend")
        self.arguments = [_argument(name, hint) for name, hint in hints.items()]
        self.Inputs = _named(f"{name}_inputs", list(hints))
        for letter, place in self._letters().items():
            setattr(self.Inputs, letter, property(eval(f"lambda given: {place}")))
        self._pack, self.results = _results(of_result)
        self._Results = _named("results", list(self.results))
        self._hint: Any = Tensor if len(self.results) == 1 else tuple[(Tensor,) * len(self.results)]  # type: ignore[misc]
        text = ", ".join(map(self._memory, self.results.values()))
        if len(self.results) != 1:  # a named tuple where the results have names
            text = f"({text})" if "result0" in self.results else f"make({text})"
        self.allocate = eval(f"lambda given: {text}", {"make": self._Results, "torch": torch})
        _DECLARED[name] = self

    def _tensors(self) -> list[Argument]:
        return [argument for argument in self.arguments if argument.kind is Tensor]

    def _letters(self) -> dict[str, str]:
        """The expression of each letter that shapes speak of."""
        names, found = [each.name for each in self.arguments], dict[str, list[tuple[str, str]]]()
        for name, _, optional, rule in self._tensors():
            forms = [(rule.shape, f"given.{name} is not None" if optional else "")]
            if rule.condition:
                there = f"given.{rule.condition} is"
                forms = [(rule.shape, f"{there} not None"), (rule.otherwise, f"{there} None")]
            for shape, known in [] if rule.either else forms:
                for place, entry in enumerate(shape):
                    if isinstance(entry, str) and entry not in names:
                        letter, _, one = entry.partition("+")
                        size = f"given.{name}.shape[{place}]{' - 1' if one else ''}"
                        found.setdefault(letter, []).append((size, known))
        sure = {letter: size for letter, ways in found.items() for size, known in reversed(ways) if not known}
        asked = {letter: [f"{size} if {known}" for size, known in ways] for letter, ways in found.items()}
        return {letter: sure.get(letter, " else ".join([*asked[letter], "0"])) for letter in found}

    def _memory(self, result: Shaped) -> str:
        """The expression of new memory for a result."""
        tensors = [each for each in self._tensors() if not each.optional]
        same = [each for each in tensors if {*each.rule.dtypes} <= {*(result.dtypes or FLOATING)}]
        first, dtype = (same[0], "") if same else (tensors[0], f", dtype={result.dtypes[0]}")
        return f"given.{first.name}.new_empty({self._shape(result)}{dtype})"

    def _values(self) -> dict[str, str]:
        """The expressions of arguments and letters."""
        found = {**{each.name: f"given.{each.name}" for each in self.arguments}, **self._letters()}
        for name in [each.name for each in self._tensors() if each.rule.either]:
            found[f"{name}_per_ray"] = f"(given.{name} is not None and given.{name}.dim() > 1)"
        return found

    def _given(self, text: str) -> str:
        """An expression of arguments and letters, as one of ``given``."""
        values = self._values()
        return re.sub(rf"\b({'|'.join(values)})\b", lambda found: f"({values[found[1]]})", text)

    def _shape(self, result: Shaped) -> str:
        first, second = (
            "(" + "".join(self._given(str(entry)) + ", " for entry in shape) + ")"
            for shape in (result.shape, result.otherwise)
        )
        return f"{first} if given.{result.condition} is not None else {second}" if result.condition else first

    def public(self, function: Callable[..., Any]) -> Any:
        """The public function: it checks its arguments, chooses a backend and calls its implementation."""
        op, parameters = self.name, inspect.signature(function).parameters
        defaults = {name: each.default for name, each in parameters.items() if each.default is not each.empty}
        ordered, positional = (
            dict.fromkeys(parameters),
            sum(each.kind is not each.KEYWORD_ONLY for each in parameters.values()),
        )
        names, sizes = [each.name for each in self.arguments], {e for each in self._tensors() for e in each.rule.shape}
        every = [(e.name, e.optional, e.check(op, e.name not in self.smooth, e.name in sizes)) for e in self.arguments]
        prepare, pack, resolve, smooth, small = self._prepare, self._pack, self._resolve, bool(self.smooth), self._small

        @functools.wraps(function)
        def public(*args: Any, **options: Any) -> Any:
            named = {**dict(zip(ordered, args)), **options}
            values, twice = {**defaults, **named}, len(named) < len(args) + len(options)
            if twice or len(args) > positional or values.keys() != ordered.keys():
                function(*args, **options)  # which has no body, and says what is wrong
            given = checks.Checked(op)
            for name, optional, check in every:
                if not optional or values[name] is not None:
                    check(given, values)
            if smooth:
                given.no_inference()
            for name in small:
                checks.check_count(op, name, values[name].numel())
            flat = [values[name] for name in names]
            if prepare is not None:
                flat = prepare(self.Inputs(*flat))
            run = resolve(op, backend=values["backend"], device=flat[0].device, dtype=flat[0].dtype)
            return run(*flat) if pack is None else pack(run(*flat))

        return public

    def plain(self, fill: Callable[..., None]) -> Callable[..., Any]:
        """An implementation that is no custom op, as nothing traces or differentiates it: `custom_op`, but for that."""
        new, inputs, allocate = tuple.__new__, self.Inputs, self.allocate

        def run(*flat: Any) -> Any:
            given = new(inputs, flat)
            if not self.results:
                return fill(given)
            found = allocate(given)
            fill(given, found)
            return found

        return run

    def custom_op(self, name: str = "", **options: Any) -> Callable[[Callable[..., None]], Op]:
        """Makes ``fill(given, found)`` a custom op: it is handed the arguments, and memory for the results.

        Args:
            name: of the custom op; without it that of the op.
            options: of `make_op`.
        """
        return lambda fill: self.make_op(name or self.name, self.plain(fill), self.allocate, fill, **options)

    def make_op(
        self, name: str, run: Callable[..., Any], fake: Callable[[Any], Any], described: Any, **options: Any
    ) -> Op:
        """The custom op that ``run`` is of the arguments; ``fake`` gives memory for its results, from a named tuple."""
        structs = Structs(inspect.Signature(self._flat(), return_annotation=self._hint))
        return make_op(name, run, lambda *flat: fake(self.Inputs._make(flat)), structs, described, **options)

    def backward_op(self, name: str, forward: Op, formula: Callable[..., Any]) -> Callable[[Callable[..., None]], Op]:
        """Makes ``fill(given, arriving, gradients)`` the gradients of a custom op.

        It is handed the arguments; named tuples of the gradients of the results, None for zero; and of memory for those
        of the smooth arguments, None where not wanted or not there.

        Args:
            name: of the custom op.
            forward: the op that it is the backward of, made by `custom_op`.
            formula: the reference, whose derivatives are the further ones.
        """
        count, width = len(self.results), len(self.arguments)
        places = [place for place, each in enumerate(self.arguments) if each.name in self.smooth]
        gradients = _named("gradients", [self.arguments[place].name for place in places])

        new, inputs = tuple.__new__, self.Inputs

        def memory(*flat: Any) -> list[Tensor]:
            empty, parts = flat[count].new_empty, zip(flat[-1], [flat[count + place] for place in places])
            return [empty(part.shape if want and part is not None else 0) for want, part in parts]

        def of(fill: Callable[..., None]) -> Op:
            def run(*flat: Any) -> list[Tensor]:
                given, found = new(inputs, flat[count:-1]), memory(*flat)
                parts = zip(found, flat[-1], places)
                there = [part if want and given[place] is not None else None for part, want, place in parts]
                fill(given, self._Results._make(flat[:count]), gradients._make(there))
                return found

            arriving = [_parameter(f"of_{each}", Tensor | None) for each in self.results]
            wanted = _parameter("wanted", Sequence[bool])
            signature = inspect.Signature([*arriving, *self._flat(), wanted], return_annotation=list[Tensor])
            op = make_op(name, run, memory, Structs(signature), fill)
            register_derivatives(forward, op, formula, places, width, count)
            return op

        return of

    def _flat(self) -> list[inspect.Parameter]:
        return [_parameter(each.name, each.kind | None if each.optional else each.kind) for each in self.arguments]

    def inputs(self, kind: Any, **others: str | Callable[[Any], Any]) -> Callable[[Any], Any]:
        """What makes a struct of the compiled module of the arguments.

        Args:
            kind: the struct, whose members are arguments or letters of their shapes.
            others: expressions of these, for members that are neither; or functions of the arguments.

        Raises:
            NameError: a member that is none of this.
        """
        values = self._values()
        for name, other in others.items():
            values[name] = self._given(other) if isinstance(other, str) else f"{name}_of(given)"
        scope = {f"{name}_of": other for name, other in others.items() if not isinstance(other, str)}
        return self._struct(kind, "given", values, scope)

    def outputs(self, kind: Any, **others: str) -> Callable[[Any], Any]:
        """What makes a struct of the compiled module, whose members are the results, of memory for these.

        Args:
            kind: the struct.
            others: results by the names of members, where they have another.
        """
        values = {name: f"found.{others.get(name, name)}" for name in [*self.results, *others]}
        return self._struct(kind, "found", values, {})

    def _struct(self, kind: Any, source: str, values: dict[str, str], scope: dict[str, Any]) -> Callable[[Any], Any]:
        if unknown := [name for name in kind._fields if name not in values]:
            raise NameError(f"{self.name}: {kind.__name__} must have members of its declaration, got {unknown}")
        members = ", ".join(values[name] for name in kind._fields)
        scope |= {"new": tuple.__new__, "kind": kind, "torch": torch}
        made: Callable[[Any], Any] = eval(f"lambda {source}: new(kind, ({members},))", scope)
        return made


def _named(name: str, fields: Sequence[str]) -> Any:
    make: Any = collections.namedtuple  # whose fields a type checker wants to read
    return make(name, fields)


def _parameter(name: str, kind: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=kind)


def _argument(name: str, hint: Any) -> Argument:
    rule = ""
    if typing.get_origin(hint) is typing.Annotated:
        hint, rule = typing.get_args(hint)
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else [hint]
    (kind,) = (kind for kind in options if kind is not type(None))
    made: Any = rule
    if kind is Tensor:
        made = Shaped.parse(rule)
    elif kind is int:
        low, _, high = rule.partition("..")
        made = int(low), int(high or MAX_COUNT)
    elif kind is float:
        made = _of_floats(rule)
    elif kind is str:
        made = rule.split("|")
    return Argument(name, kind, hint is not kind, made)


def _of_floats(rule: str) -> Callable[[str, str, float], None]:
    if rule == "positive":
        return checks.check_positive
    if not rule:
        return checks.check_number
    low, high = (float(end) for end in re.findall(r"[\d.]+", rule))
    return lambda op, name, value: checks.check_interval(op, name, value, low, high, rule)


def _results(hint: Any) -> tuple[Callable[[Any], Any] | None, dict[str, Shaped]]:
    """What puts results together for the caller, if anything, and all tensors by their names."""
    if hint is type(None):
        return None, {}
    if typing.get_origin(hint) is typing.Annotated:
        return None, {"result": Shaped.parse(typing.get_args(hint)[1])}
    if hasattr(hint, "_fields"):
        fields = typing.get_type_hints(hint, include_extras=True)
        return hint._make, {name: _results(field)[1]["result"] for name, field in fields.items()}
    first, *others = typing.get_args(hint)
    if hasattr(first, "_fields"):  # what is found, and its gradient
        count = len(first._fields)
        return lambda found: (first(*found[:count]), *found[count:]), {
            **_results(first)[1],
            "gradient": _results(*others)[1]["result"],
        }
    return None, {f"result{place}": _results(part)[1]["result"] for place, part in enumerate((first, *others))}
