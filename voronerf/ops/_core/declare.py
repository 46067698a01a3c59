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
arguments one after another. The compiled module does all of it where it can (csrc/bindings/signature.cpp), and Python
where an argument is wrong, or is no plain tensor. From the same signature come the schema of custom ops, memory for
their results (which is their fake), their gradients (`Declaration.backward_op`), and the members of compiled structs
(`Declaration.inputs` and `Declaration.outputs`).

A tensor is written as its dtypes and its shape. The dtypes are ``floating``, names of some (``float32|float64``),
``same`` as the first floating-point tensor, or ``wide``, the same but at least float32. The shape has numbers, letters,
a letter plus one, and arguments that are integers. Of ``[3] or [r, 3]`` the first holds for a tensor of as many
dimensions, of ``[m] if ray_offsets else [r, s]`` where that argument is given. The shape of a result may also have
letters that functions of the arguments give (``sizes``). An int is written as a range (``1..4``, ``0..``), a float as
``positive``, or an interval (``[0, 1)``, ``0 to 1``), a str as its choices (``linear|disparity``). What is written by
its class alone is an instance of it. The docstring says what arguments mean; what the signature says of tensors is put
before it, and the backends behind it.
"""

from __future__ import annotations

import collections
import functools
import inspect
import operator
import re
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from voronerf.ops._core import backends, checks
from voronerf.ops._core.backends import Implementation
from voronerf.ops._core.checks import FLOATING, LIKE_FIRST, MAX_COUNT
from voronerf.ops._core.custom_op import Op, custom_op
from voronerf.ops._core.derivatives import register_derivatives
from voronerf.ops._core.rows import new_empty, rows_of

F = TypeVar("F", bound=Callable[..., Any])
_DECLARED: dict[str, Declaration] = {}
_DTYPES = {"floating": FLOATING, "same": LIKE_FIRST, "wide": LIKE_FIRST}


def declare(**options: Any) -> Callable[[F], F]:
    """Makes the public function of an op from its signature, with the options of `Declaration`."""

    def of(function: F) -> F:
        made: F = Declaration(function, **options).public()
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
    text: str = ""

    @property
    def either(self) -> bool:
        """Whether it may have the one shape or the other."""
        return bool(self.otherwise) and not self.condition

    @property
    def row(self) -> tuple[Any, ...]:
        """The same for the compiled module."""
        names = [str(dtype).removeprefix("torch.") for dtype in self.dtypes]
        kind = "wide" if self.wide else "" if names else "same"
        return names, kind, self.shape, self.otherwise or None

    @staticmethod
    def parse(text: str) -> Shaped:
        """Of what a signature says."""
        found = re.fullmatch(r"([\w|]+) \[(.*?)\](?: (?:if (\w+) else|or) \[(.*)\])?", text)
        assert found is not None, f"a tensor is written as dtypes and a shape, got {text!r}"
        dtypes, shape, condition, otherwise = found.groups()
        known = _DTYPES.get(dtypes)
        if known is None:
            known = tuple(getattr(torch, name) for name in dtypes.split("|"))
        return Shaped(known, _entries(shape), dtypes == "wide", condition or "", _entries(otherwise or ""), text)


def _entries(text: str) -> tuple[int | str, ...]:
    parts = [part for part in text.replace(" ", "").split(",") if part]
    return tuple(int(part) if part.isdigit() else part for part in parts)


class Argument(NamedTuple):
    """An argument of a signature."""

    name: str
    kind: Any
    optional: bool
    rule: Any
    text: str = ""

    @property
    def floating(self) -> bool:
        """Whether it is a tensor that may have gradients."""
        return self.kind is Tensor and (not self.rule.dtypes or bool({*self.rule.dtypes} & {*FLOATING}))

    def check(self, given: checks.Checked, values: dict[str, Any]) -> None:
        """Checks its value in a call, one of ``values`` by name, and makes an integer a float where one is asked."""
        name, kind, rule, value = self.name, self.kind, self.rule, values[self.name]
        if kind is Tensor:
            self._check_tensor(given, values)
        elif kind is int:
            checks.check_integer(given.op, name, value, *rule)
        elif kind is float:
            rule(given.op, name, value)
            values[name] = float(value)
        elif kind is bool:
            checks.check_flag(given.op, name, value)
        elif kind is str:
            checks.check_choice(given.op, name, value, rule)
        elif isinstance(rule, type):
            checks.check_kind(given.op, name, value, rule)

    def _check_tensor(self, given: checks.Checked, values: dict[str, Any]) -> None:
        rule, tensor = self.rule, values[self.name]
        other = bool(rule.condition) and values[rule.condition] is None
        if rule.either:
            checks.check_tensor(given.op, self.name, tensor)
            other = tensor.dim() != len(rule.shape)
        dtypes = [torch.promote_types(given.first_float().dtype, torch.float32)] if rule.wide else rule.dtypes
        given.tensor(self.name, tensor, dtypes, *(rule.otherwise if other else rule.shape))


class Source(NamedTuple):
    """The origin of a parameter of a compiled function, or of a member of its structs.

    Attributes:
        of: gives it, of the arguments of an op and the memory for its results.
        told: what the compiled module is told, which takes it from there itself.
    """

    of: Callable[[Any, Any], Any]
    told: tuple[Any, ...]

    def __call__(self, given: Any) -> Any:
        """The same of the arguments alone, or of the results alone."""
        return self.of(given, given)


class Memory:
    """Memory that a compiled function writes for itself.

    Args:
        dtype: of its entries.
        shape: letters.
    """

    def __init__(self, dtype: torch.dtype, *shape: str) -> None:
        self.dtype, self.shape = dtype, shape


@dataclass(eq=False)
class Declaration:
    """What the signature of an op says.

    Args:
        function: which has the signature.
        native: of csrc/, as the row of the table of backends has it.
        warp: of kernels/.
        reference: in plain PyTorch.
        smooth: the arguments that have gradients. The others are detached.
        small: the arguments whose elements an int32 must number.
        writes: the arguments that it writes into.
        sizes: letters of the results that are no argument's, as functions of the arguments.
        filled: letters that are at least 1, and what an error says where they are not.
        compared: two arguments that are compared, for which they are given one type (`checks.of_one_dtype`).
        prepare: takes the checked arguments, as a named tuple, and gives those of the implementations; it checks what
            the signature cannot say.
        composed: whether the reference takes the ``backend`` of other ops that it calls (`resolve_composed`).

    Attributes:
        name: of the op.
        arguments: one after another, without ``backend``.
        results: tensors, by their names.
        allocate: memory for the results, from the named tuple.
        Inputs: the arguments as a named tuple, which has the letters of their shapes as attributes.
    """

    function: Callable[..., Any]
    native: Implementation | None = None
    warp: Implementation | None = None
    reference: Implementation = field(default_factory=Implementation)
    smooth: Sequence[str] = ()
    small: Sequence[str] = ()
    writes: Sequence[str] = ()
    sizes: Mapping[str, Callable[[Any], int]] = field(default_factory=dict)
    filled: Mapping[str, str] = field(default_factory=dict)
    compared: Sequence[str] = ()
    prepare: Callable[[Any], Any] | None = None
    composed: bool = False

    def __post_init__(self) -> None:
        self.name = self.function.__name__
        backends.declare(self.name, native=self.native, warp=self.warp, reference=self.reference)
        hints = typing.get_type_hints(self.function, include_extras=True)
        of_result = hints.pop("return")
        hints.pop("backend")
        self.arguments = [_argument(name, hint) for name, hint in hints.items()]
        kinds = {each.name: each.kind | None if each.optional else each.kind for each in self.arguments}
        self._places = {name: place for place, name in enumerate(kinds)}
        self.Inputs = _named(f"{self.name}_inputs", kinds)
        for letter, size in {**self._letters(), **self.sizes}.items():
            setattr(self.Inputs, letter, property(size))
        self._pack, self.results = _results(of_result)
        self._results_class = of_result if hasattr(of_result, "_fields") else None
        self._Results = _named("results", dict.fromkeys(self.results, Tensor))
        self.allocate = self._memory()
        _DECLARED[self.name] = self

    def _tensors(self) -> list[Argument]:
        return [argument for argument in self.arguments if argument.kind is Tensor]

    def _letters(self) -> dict[str, Callable[[Any], Any]]:
        """What gives each letter that shapes speak of, and of a tensor of either form whether it has one per ray."""
        ways, found = dict[str, list[tuple[int, int, int, int]]](), dict[str, Callable[[Any], Any]]()
        for name, _, _, rule, _ in self._tensors():
            if rule.either:
                found[f"{name}_per_ray"] = _is_per_ray(self._places[name])
                continue
            for shape in (rule.shape, rule.otherwise):
                for dimension, entry in enumerate(shape):
                    if isinstance(entry, str) and entry not in self._places:
                        letter, _, one = entry.partition("+")
                        ways.setdefault(letter, []).append((len(shape), self._places[name], dimension, len(one)))
        return {**found, **{letter: _size_of(sorted(each)) for letter, each in ways.items()}}

    def _likes(self) -> list[tuple[str, torch.dtype | None]]:
        """For each result the argument beside which its memory lies, and its dtype where that is another one."""
        tensors, found = [each for each in self._tensors() if not each.optional], list[tuple[str, torch.dtype | None]]()
        for result in self.results.values():
            same = [each for each in tensors if {*each.rule.dtypes} <= {*(result.dtypes or FLOATING)}]
            found.append((same[0].name, None) if same else (tensors[0].name, result.dtypes[0]))
        return found

    def _memory(self) -> Callable[[Any], Any]:
        """Makes the function that allocates the results: a named tuple where they have names."""
        rows, kind = [*zip(self.results.values(), self._likes())], tuple
        if "result0" not in self.results:
            kind = self._Results

        def allocate(given: Any) -> Any:
            found = []
            for result, (like, dtype) in rows:
                other = bool(result.condition) and getattr(given, result.condition) is None
                shape = [_size_in(given, entry) for entry in (result.otherwise if other else result.shape)]
                found.append(new_empty(getattr(given, like), *shape, dtype=dtype))
            return tuple.__new__(kind, found) if len(found) > 1 else found[0] if found else None

        hint: Any = Tensor if len(rows) == 1 else tuple[(Tensor,) * len(rows)]  # type: ignore[misc]
        allocate.__annotations__ = {"given": self.Inputs, "return": hint if rows else None}
        return allocate

    def public(self) -> Any:
        """The public function: it checks its arguments, chooses a backend and calls its implementation.

        The compiled module does so where it can (csrc/bindings/signature.cpp). Where it is not there, where an argument
        breaks a rule, or is no plain tensor, `_call` does.
        """
        function, self._calls, traces = self.function, self._first_call, torch.compiler.is_dynamo_compiling

        @functools.wraps(function)
        def public(*args: Any, **options: Any) -> Any:
            if not traces():
                found = self._calls(args, options)
                if found is not NotImplemented:
                    return found
            return self._call(args, options)

        parameters = inspect.signature(function).parameters
        self._defaults = {name: each.default for name, each in parameters.items() if each.default is not each.empty}
        self._ordered = dict.fromkeys(parameters)
        self._positional = sum(each.kind is not each.KEYWORD_ONLY for each in parameters.values())
        shapes = [each.rule.shape for each in self._tensors()] + [each.shape for each in self.results.values()]
        self._bound = {str(entry).removesuffix("+1") for shape in shapes for entry in shape}
        public.__doc__ = self._described()
        return public

    def _call(self, args: tuple[Any, ...], options: dict[str, Any]) -> Any:
        """A call in Python, which says what is wrong with its arguments."""
        named = {**dict(zip(self._ordered, args)), **options}
        values, twice = {**self._defaults, **named}, len(named) < len(args) + len(options)
        if twice or len(args) > self._positional or values.keys() != self._ordered.keys():
            self.function(*args, **options)  # which has no body, and says what is wrong
        given = checks.Checked(self.name)
        for each in self.arguments:
            if each.optional and values[each.name] is None:
                continue
            each.check(given, values)
            if each.kind is not Tensor and each.name in self._bound:
                given.sizes[each.name] = values[each.name]
            if each.floating and each.name not in self.smooth and values[each.name].requires_grad:
                values[each.name] = values[each.name].detach()
        if self.smooth:
            given.no_inference()
        for name in self.writes:
            checks.check_writable(self.name, name, values[name])
        for name in self.small:
            checks.check_count(self.name, name, values[name].numel())
        for letter, rule in self.filled.items():
            if given.sizes[letter] < 1:
                raise ValueError(f"{self.name}: {rule}")
        if self.compared:
            one, two = self.compared
            values[one], values[two] = checks.of_one_dtype(values[one], values[two])
        flat = [values[name] for name in self._places]
        if self.prepare is not None:
            flat = self.prepare(self.Inputs(*flat))
        resolve = backends.resolve_composed if self.composed else backends.resolve
        run = resolve(self.name, backend=values["backend"], device=flat[0].device, dtype=flat[0].dtype)
        return run(*flat) if self._pack is None else self._pack(run(*flat))

    def _first_call(self, args: tuple[Any, ...], options: dict[str, Any]) -> Any:
        """Makes what the compiled module calls the op with, and calls it."""
        native = backends.compiled()
        if native is None:
            return NotImplemented
        rows = [{**self._row(each), **self._default(each.name)} for each in self.arguments]
        rows.append({"name": "backend", "kind": "any", "optional": False, "rule": None, **self._default("backend")})
        more = {
            "filled": list(self.filled),
            "compared": [self._places[name] for name in self.compared],
            "smooth": bool(self.smooth),
            "inputs": self.Inputs,
            "prepare": self.prepare,
            "found": self._found,
            "pack": self._pack,
        }
        self._calls = native.signature(self.name, rows, self._positional, more)
        return self._calls(args, options)

    def _default(self, name: str) -> dict[str, Any]:
        return {"default": self._defaults[name]} if name in self._defaults else {}

    def _row(self, argument: Argument) -> dict[str, Any]:
        """Describes an argument to the compiled module."""
        name, kind, optional, rule, text = argument
        row = {"name": name, "optional": optional, "bound": name in self._bound, "rule": rule, "kind": "any"}
        if kind is Tensor:
            return {
                **row,
                "kind": "tensor",
                "rule": rule.row,
                "either": rule.either,
                "condition": self._places.get(rule.condition, -1),
                "detached": name not in self.smooth and argument.floating,
                "small": name in self.small,
                "written": name in self.writes,
            }
        if kind is float:
            ends = [float(end) for end in re.findall(r"[\d.]+", text)] or [0.0, 0.0]
            return {**row, "kind": "float", "rule": text, "ends": tuple(ends)}
        if kind in (int, bool, str):
            return {**row, "kind": kind.__name__}
        return {**row, "kind": "instance"} if isinstance(rule, type) else row

    def _found(self, name: str, backend: str) -> tuple[Any, Any, bool]:
        """An implementation, how the compiled module calls it by itself (`Op.plan`), and whether in float32 alone."""
        run = backends.function(self.name, name, backend, self.composed)
        op = getattr(run, "op", run)
        return run, getattr(op, "plan", None), op is not run

    def _described(self) -> str:
        """The docstring, with the dtypes and the shape of each tensor, which the signature has, and the backends."""
        text = self.function.__doc__ or ""
        for name, _, optional, rule, _ in self._tensors():
            form = f"{rule.text} or None" if optional else rule.text
            text = re.sub(rf"^( +{name}: )", rf"\g<1>{form}, ", text, count=1, flags=re.MULTILINE)
        known = {"auto": True, "reference": True, "native": self.native, "warp": self.warp}
        *others, last = [f'"{name}"' for name, there in known.items() if there]
        backend = f"        backend: {', '.join(others)} or {last}.\n"
        return re.sub(r"^ {4}Args:\n(?: {8}.+\n)+", rf"\g<0>{backend}", text, count=1, flags=re.MULTILINE)

    def custom_op(self, name: str = "", **options: Any) -> Callable[[Callable[..., Any]], Op]:
        """Makes ``fill(given, found)`` a custom op: it is handed the arguments, and memory for the results.

        Args:
            name: of the custom op; without it that of the op.
            options: of `custom_op`; with ``fake`` only the kernels know how many rows there are, and ``fill(given)``
                makes its results.
        """
        memory, fake = self.allocate, options.pop("fake", None)
        if fake is not None:
            memory = functools.wraps(self.allocate)(lambda given: fake(given))
        return custom_op(name or self.name, memory, mutates=self.writes, counted=fake is not None, **options)

    def backward_op(self, name: str, forward: Op, formula: Callable[..., Any]) -> Callable[[Callable[..., None]], Op]:
        """Makes ``fill(given, arriving, gradients)`` the gradients of a custom op.

        It is handed the arguments; named tuples of the gradients of the results, None for zero; and of memory for those
        of the smooth arguments, None where not wanted or not there.

        Args:
            name: of the custom op.
            forward: the op that it is the backward of, made by `custom_op`.
            formula: the reference, whose derivatives are the further ones.
        """
        count, width, new = len(self.results), len(self.arguments), tuple.__new__
        places = [place for place, each in enumerate(self.arguments) if each.name in self.smooth]
        gradients = _named("gradients", dict.fromkeys(self.smooth, Tensor | None))
        arriving = {f"of_{each}": Tensor | None for each in self.results}
        kind = _named("given", {**arriving, **typing.get_type_hints(self.Inputs), "wanted": Sequence[bool]})

        def memory(flat: Any) -> list[Tensor]:
            like, parts = flat[count], zip(flat[-1], [flat[count + place] for place in places])
            return [
                new_empty(like, rows_of(part), *part.shape[1:]) if want and part is not None else like.new_empty(0)
                for want, part in parts
            ]

        memory.__annotations__["flat"] = kind

        def of(fill: Callable[..., None]) -> Op:
            @functools.wraps(fill)
            def run(flat: Any, found: list[Tensor]) -> None:
                given, parts = new(self.Inputs, flat[count:-1]), zip(found, flat[-1], places)
                there = [part if want and given[place] is not None else None for part, want, place in parts]
                fill(given, new(self._Results, flat[:count]), new(gradients, there))

            op = custom_op(name, memory)(run)
            register_derivatives(forward, op, formula, places, width, count)
            return op

        return of

    def inputs(self, kind: Any, **others: Any) -> Source:
        """What makes a struct of the compiled module of the arguments.

        Args:
            kind: the struct, whose members are arguments or letters of their shapes.
            others: for members that are neither, or have another name: the name, a function of the arguments, or what
                the member is in every call.

        Raises:
            NameError: a member that is none of this.
        """
        return self._struct(kind, others, self.Inputs)

    def outputs(self, kind: Any, **others: str) -> Source:
        """What makes a struct of the compiled module, whose members are the results, of memory for these.

        Args:
            kind: the struct.
            others: results by the names of members, where they have another.
        """
        return self._struct(kind, others, self._Results)

    def _struct(self, kind: Any, others: dict[str, Any], source: Any) -> Source:
        values = [others.get(name, name) for name in kind._fields]
        names = [value for value in values if isinstance(value, str)]
        if unknown := [name for name in names if not hasattr(source, name.partition(".")[0])]:
            raise NameError(f"{self.name}: {kind.__name__} must have members of its declaration, got {unknown}")
        of_results, new, known = source is self._Results, tuple.__new__, operator.attrgetter(*names, "__len__")
        rest = [(place, value) for place, value in enumerate(values) if not isinstance(value, str)]

        def of(given: Any, found: Any) -> Any:
            *parts, _ = known(found if of_results else given)  # all at once: members are many
            for place, value in rest:
                parts.insert(place, value(given) if callable(value) else value)
            return new(kind, parts)

        return Source(of, ("structure", [self._source(value, of_results).told for value in values]))

    def _source(self, value: Any, of_results: bool = False) -> Source:
        """The origin of a parameter or a member, by its name or what else `compiled_op` takes."""
        if isinstance(value, Source):
            return value
        if isinstance(value, Memory):
            shape, dtype = value.shape, value.dtype
            make = lambda given, _: new_empty(given[0], *[getattr(given, n) for n in shape], dtype=dtype)  # noqa: E731
            return Source(make, ("memory", dtype.itemsize, shape))
        if not isinstance(value, str):
            if callable(value):
                return Source(lambda given, _: value(given), ("function", value))
            return Source(lambda given, _: value, ("constant", value))
        if value in self.results and (of_results or value not in self._places):
            place = [*self.results].index(value)
            alone = len(self.results) == 1
            return Source(lambda _, found: found if alone else found[place], ("result", place))
        get = operator.attrgetter(value)
        told: tuple[Any, ...] = ("letter", value) if value in self._letters() else ("function", get)
        if value in self._places:
            told = "argument", self._places[value]
        elif value.endswith("_per_ray"):
            told = "rays", self._places[value.removesuffix("_per_ray")]
        return Source(lambda given, _: get(given), told)

    def _result_rows(self) -> list[tuple[Any, ...]]:
        """Describes the results to the compiled module."""
        known = {*self._places, *self._letters()}

        def told(shape: Sequence[int | str]) -> list[Any]:
            """Letters that only a function of the arguments gives, as that."""
            return [
                entry if isinstance(entry, int) or entry.removesuffix("+1") in known else operator.attrgetter(entry)
                for entry in shape
            ]

        return [
            (self._places[like], dtype, self._places.get(each.condition, -1), told(each.shape), told(each.otherwise))
            for each, (like, dtype) in zip(self.results.values(), self._likes())
        ]

    def compiled_op(
        self,
        name: str,
        function: str,
        *parameters: Any,
        on_cuda: Callable[[Any, Any, Any], None] | None = None,
        fault: Callable[[Any], Any] | None = None,
        **options: Any,
    ) -> Op:
        """The custom op that is a function of the compiled module.

        A plain call of it, on the CPU, is made without Python (csrc/bindings/signature.cpp).

        Args:
            name: of the custom op; without it that of the op.
            function: its name.
            parameters: of the function, without the machine: names of arguments, results and letters, what `inputs`
                and `outputs` give, a `Memory`, a function of the arguments, or what is the same in every call.
            on_cuda: what fills the results there, of the arguments, the results and the machine, where that function
                has other parameters.
            fault: what is called with the arguments where the function gives False: it raises the error.
            options: of `custom_op`.
        """
        from voronerf.ops._core import native

        sources, on_devices = [*map(self._source, parameters)], "cuda" in options.get("devices", ("cuda",))

        def fill(given: Any, found: Any) -> None:
            machine = native.machine(given[0]) if on_devices else native.cpu()
            if on_cuda is not None and isinstance(machine, native.compiled.Cuda):
                on_cuda(given, found, machine)
                return
            said = getattr(native.compiled, function)(*[source.of(given, found) for source in sources], machine)
            if said is False and fault is not None:
                fault(given)

        op = self.custom_op(name, **options)(functools.wraps(self.function)(fill))
        op.__module__ = f"voronerf.ops.{backends.folder(self.name)}.native"
        pack = self._results_class or self._pack
        op.plan = function, [source.told for source in sources], self._result_rows(), pack, fault
        return op


def _size_of(ways: Sequence[tuple[int, int, int, int]]) -> Callable[[Any], int]:
    """What gives a letter, of the first tensor that is there with so many dimensions, by its place: the size of one of
    its dimensions, less one or not. 0 where there is none."""

    def size(given: Any) -> int:
        for dimensions, place, dimension, less in ways:
            tensor = given[place]
            if tensor is not None and tensor.dim() == dimensions:
                found = tensor.shape[dimension] if dimension else rows_of(tensor)
                return found - less
        return 0

    return size


def _is_per_ray(place: int) -> Callable[[Any], bool]:
    return lambda given: given[place] is not None and given[place].dim() > 1


def _size_in(given: Any, entry: int | str) -> int:
    """A size of a shape."""
    if isinstance(entry, int):
        return entry
    size: int = getattr(given, entry.removesuffix("+1"))
    return size + 1 if entry.endswith("+1") else size


def _named(name: str, hints: dict[str, Any]) -> Any:
    make: Any = collections.namedtuple  # whose fields a type checker wants to read
    found = make(name, hints)
    found.__annotations__ = hints
    return found


def _argument(name: str, hint: Any) -> Argument:
    rule = ""
    if typing.get_origin(hint) is typing.Annotated:
        hint, rule = typing.get_args(hint)
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else [hint]
    (kind,) = (kind for kind in options if kind is not type(None))
    made: Any = kind
    if kind is Tensor:
        made = Shaped.parse(rule)
    elif kind is int:
        low, _, high = rule.partition("..")
        made = int(low), int(high or MAX_COUNT)
    elif kind is float:
        made = _of_floats(rule)
    elif kind is str:
        made = rule.split("|")
    return Argument(name, kind, hint is not kind, made, rule)


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
