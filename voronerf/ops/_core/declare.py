"""The declaration of an op: the signature of its public function.

::

    @declare(native=Implementation(EVERYWHERE, COORDINATES))
    def nearest_centre(
        points: Annotated[Tensor, "floating [n, 3]"],
        centres: Annotated[Tensor, "floating [k, 3]"],
        *,
        backend: str = "auto",
    ) -> Annotated[Tensor, "int32 [n]"]:
        \"\"\"The docstring; the function has no body.\"\"\"

The decorator makes the public function, which checks the arguments, chooses a backend, and calls the backend's
implementation with positional arguments. The compiled module does all this (csrc/bindings/signature.cpp); Python does
it without the compiled module and while torch's compiler traces. The signature also gives the schema of custom ops, the
allocation of their results (also used as the fake), their gradients (`Declaration.backward_op`), and the members of
compiled structs (`Declaration.inputs` and `Declaration.outputs`).

A tensor's annotation has dtypes and a shape. The dtypes are ``floating``, a list of names (``float32|float64``),
``same`` for the dtype of the first floating-point tensor, or ``wide`` for this dtype promoted to at least float32. An
entry of a shape is a number, a letter, a letter plus one, or the name of an integer argument. ``[3] or [r, 3]`` allows
either shape; the two shapes must differ in the number of dimensions. ``[m] if ray_offsets else [r, s]`` is [m] if the
argument ``ray_offsets`` is not None. The shape of a result may also have letters that are functions of the arguments
(``sizes``).

An int's annotation is a range (``1..4``, ``0..``), a float's is ``positive`` or an interval (``[0, 1)``, ``0 to 1``), a
str's is its choices (``linear|disparity``). An argument annotated with a class alone must be an instance of it. The
docstring describes the arguments; the decorator adds each tensor's dtypes and shape, and the backends.
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
from voronerf.ops._core.checks import FLOATING, LIKE_FIRST, MAX_COUNT, TensorRule
from voronerf.ops._core.custom_op import Op, custom_op
from voronerf.ops._core.derivatives import register_derivatives
from voronerf.ops._core.rows import new_empty, rows_of

F = TypeVar("F", bound=Callable[..., Any])
_DECLARED: dict[str, Declaration] = {}
_DTYPES = {"floating": FLOATING, "same": LIKE_FIRST, "wide": LIKE_FIRST}


def declare(**options: Any) -> Callable[[F], F]:
    """Makes the public function of an op from its signature, with the options of `Declaration`."""

    def decorate(function: F) -> F:
        public: F = Declaration(function, **options).public()
        return public

    return decorate


def declared(name: str) -> Declaration:
    """Returns the declaration of an op."""
    return _DECLARED[name]


def tensor_rule(name: str, text: str) -> TensorRule:
    """Returns the rule of a tensor from its annotation."""
    match = re.fullmatch(r"([\w|]+) \[(.*?)\](?: (?:if (\w+) else|or) \[(.*)\])?", text)
    assert match is not None, f"a tensor is written as dtypes and a shape, got {text!r}"
    dtypes, shape, condition, otherwise = match.groups()
    known_dtypes = _DTYPES.get(dtypes)
    if known_dtypes is None:
        known_dtypes = tuple(getattr(torch, name) for name in dtypes.split("|"))
    rule = TensorRule(name, known_dtypes, _entries(shape), wide=dtypes == "wide", condition=condition or "")
    return rule._replace(otherwise=_entries(otherwise or ""))


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
        """Returns whether the argument is a tensor that may have a floating-point dtype."""
        return self.kind is Tensor and (not self.rule.dtypes or bool({*self.rule.dtypes} & {*FLOATING}))

    def check(self, op: str, value: Any) -> Any:
        """Checks and returns the value of an argument that is no tensor; converts it to float for a float argument."""
        name, kind, rule = self.name, self.kind, self.rule
        if kind is int:
            checks.check_integer(op, name, value, *rule)
        elif kind is float:
            checks.check_number(op, name, value, self.text, rule)
            return float(value)
        elif kind is bool:
            checks.check_flag(op, name, value)
        elif kind is str:
            checks.check_choice(op, name, value, rule)
        elif isinstance(rule, type):
            checks.check_kind(op, name, value, rule)
        return value


class Binding(NamedTuple):
    """The source of a parameter of a compiled function, or of a member of the function's structs.

    Attributes:
        get: a function that returns the parameter, given the arguments of an op and the memory for its results.
        plan: the description from which the compiled module gets the parameter without ``get``.
    """

    get: Callable[[Any, Any], Any]
    plan: tuple[Any, ...]

    def __call__(self, arguments: Any) -> Any:
        """Returns the parameter; ``arguments`` are the op's arguments, or the results if it reads only results."""
        return self.get(arguments, arguments)


class Memory:
    """Scratch memory of a compiled function.

    Args:
        dtype: the dtype of the memory.
        shape: the letters of the shape.
    """

    def __init__(self, dtype: torch.dtype, *shape: str) -> None:
        self.dtype, self.shape = dtype, shape


@dataclass(eq=False)
class Declaration:
    """The declaration of an op, parsed from its signature.

    Args:
        function: the function with the signature.
        native: the implementation in csrc/, for the table of backends.
        warp: the implementation in kernels/.
        reference: the implementation in plain PyTorch.
        smooth: the arguments that have gradients. All other arguments are detached.
        small: the arguments whose number of elements must fit an int32.
        writes: the arguments that the op writes into.
        sizes: functions of the arguments, for letters that occur only in results.
        filled: letters that must be at least 1, and the text of the error.
        prepare: a function from the checked arguments, as a named tuple, to the implementations' arguments. It checks
            rules that the signature cannot express.
        compared: two arguments; `prepare` is left out if both are float32 or both are float64.
        composed: whether the reference passes ``backend`` to other ops that it calls (`resolve_composed`).

    Attributes:
        name: the op's name.
        arguments: the arguments in order, without ``backend``.
        results: the result tensors, by name.
        allocate: the function that allocates the results, from the named tuple of arguments.
        Inputs: the named tuple of the arguments; the letters of their shapes are its attributes.
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
    prepare: Callable[[Any], Any] | None = None
    compared: Sequence[str] = ()
    composed: bool = False

    def __post_init__(self) -> None:
        self.name = self.function.__name__
        backends.declare(self.name, native=self.native, warp=self.warp, reference=self.reference)
        hints = typing.get_type_hints(self.function, include_extras=True)
        of_result = hints.pop("return")
        hints.pop("backend")
        self.arguments = [
            _argument(name, hint, name in self.small, name in self.writes) for name, hint in hints.items()
        ]
        kinds = {arg.name: arg.kind | None if arg.optional else arg.kind for arg in self.arguments}
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
        """Returns functions of the op's arguments, by name: one for the size of each letter, and ``<name>_per_ray``.

        ``<name>_per_ray`` returns whether a tensor that may have either of two shapes has one row for each ray.
        """
        ways, letters = dict[str, list[tuple[int, int, int, int]]](), dict[str, Callable[[Any], Any]]()
        for name, _, _, rule, _ in self._tensors():
            if rule.either:
                letters[f"{name}_per_ray"] = _is_per_ray(self._places[name])
                continue
            for shape in (rule.shape, rule.otherwise):
                for dimension, entry in enumerate(shape):
                    if isinstance(entry, str) and entry not in self._places:
                        letter, _, one = entry.partition("+")
                        ways.setdefault(letter, []).append((len(shape), self._places[name], dimension, len(one)))
        return {**letters, **{letter: _size_of(sorted(letter_ways)) for letter, letter_ways in ways.items()}}

    def _likes(self) -> list[tuple[str, torch.dtype | None]]:
        """Returns for each result the name of an argument on the same device, and the dtype of the result.

        The dtype is None if the result has the dtype of this argument.
        """
        tensors, likes = [arg for arg in self._tensors() if not arg.optional], list[tuple[str, torch.dtype | None]]()
        for result in self.results.values():
            matching = [arg for arg in tensors if {*arg.rule.dtypes} <= {*(result.dtypes or FLOATING)}]
            likes.append((matching[0].name, None) if matching else (tensors[0].name, result.dtypes[0]))
        return likes

    def _memory(self) -> Callable[[Any], Any]:
        """Returns the function that allocates the results. Results with names form a named tuple."""
        rows, kind = [*zip(self.results.values(), self._likes())], tuple
        if "result0" not in self.results:
            kind = self._Results

        def allocate(given: Any) -> Any:
            results = []
            for result, (like, dtype) in rows:
                second_shape = bool(result.condition) and getattr(given, result.condition) is None
                shape = [_size_in(given, entry) for entry in (result.otherwise if second_shape else result.shape)]
                results.append(new_empty(getattr(given, like), *shape, dtype=dtype))
            return tuple.__new__(kind, results) if len(results) > 1 else results[0] if results else None

        hint: Any = Tensor if len(rows) == 1 else tuple[(Tensor,) * len(rows)]  # type: ignore[misc]
        allocate.__annotations__ = {"given": self.Inputs, "return": hint if rows else None}
        return allocate

    def public(self) -> Any:
        """Returns the public function: it checks its arguments, chooses a backend and calls the implementation.

        The compiled module handles the call (csrc/bindings/signature.cpp), or `_call` without the module, and while
        torch's compiler traces.
        """
        function, self._calls, traces = self.function, self._first_call, torch.compiler.is_dynamo_compiling

        @functools.wraps(function)
        def public(*args: Any, **options: Any) -> Any:
            if not traces():
                result = self._calls(args, options)
                if result is not NotImplemented:
                    return result
            return self._call(args, options)

        parameters = inspect.signature(function).parameters
        self._defaults = {name: each.default for name, each in parameters.items() if each.default is not each.empty}
        self._ordered = dict.fromkeys(parameters)
        self._positional = sum(each.kind is not each.KEYWORD_ONLY for each in parameters.values())
        shapes = [each.rule.shape for each in self._tensors()] + [each.shape for each in self.results.values()]
        self._bound = {str(entry).removesuffix("+1") for shape in shapes for entry in shape}
        public.__doc__ = self._docstring()
        return public

    def _call(self, args: tuple[Any, ...], options: dict[str, Any]) -> Any:
        """Checks and makes a call in Python: while torch's compiler traces, and without the compiled module."""
        named = {**dict(zip(self._ordered, args)), **options}
        values, repeated = {**self._defaults, **named}, len(named) < len(args) + len(options)
        if repeated or len(args) > self._positional or values.keys() != self._ordered.keys():
            self.function(*args, **options)  # the empty function raises Python's TypeError
        sizes: dict[str, int] = {}
        tensors: list[Tensor] = []
        for argument in self.arguments:
            name, rule, value = argument.name, argument.rule, values[argument.name]
            if argument.optional and value is None:
                continue
            if argument.kind is Tensor:
                second_shape = bool(rule.condition) and values[rule.condition] is None
                checks.fit(self.name, rule, value, sizes, tensors, second_shape)
                if argument.floating and name not in self.smooth and value.requires_grad:
                    values[name] = value.detach()
                continue
            values[name] = argument.check(self.name, value)
            if name in self._bound:
                sizes[name] = values[name]
        for letter, text in self.filled.items():
            if sizes[letter] < 1:
                raise ValueError(f"{self.name}: {text}")
        given = self.Inputs(*[values[name] for name in self._places])
        flat = given if self.prepare is None else self.prepare(given)
        resolve = backends.resolve_composed if self.composed else backends.resolve
        run = resolve(self.name, backend=values["backend"], device=flat[0].device, dtype=flat[0].dtype)
        return run(*flat) if self._pack is None else self._pack(run(*flat))

    def _first_call(self, args: tuple[Any, ...], options: dict[str, Any]) -> Any:
        """Makes the op's callable in the compiled module, at the first call of the op, and calls it."""
        native = backends.compiled()
        if native is None:
            return NotImplemented
        self._calls = native.signature(self)
        return self._calls(args, options)

    def _implementation(self, name: str, backend: str) -> tuple[Any, Any, bool]:
        """Returns an implementation, its `Op.plan` or None, and whether it is wrapped by `in_float32`."""
        run = backends.function(self.name, name, backend, self.composed)
        op = getattr(run, "op", run)
        return run, getattr(op, "plan", None), op is not run

    def _docstring(self) -> str:
        """Returns the docstring, with each tensor's dtypes and shape from the signature, and with the backends."""
        text = self.function.__doc__ or ""
        for name, _, optional, _, rule in self._tensors():
            form = f"{rule} or None" if optional else rule
            text = re.sub(rf"^( +{name}: )", rf"\g<1>{form}, ", text, count=1, flags=re.MULTILINE)
        backends = {"auto": True, "reference": True, "native": self.native, "warp": self.warp}
        *others, last = [f'"{name}"' for name, exists in backends.items() if exists]
        backend = f"        backend: {', '.join(others)} or {last}.\n"
        return re.sub(r"^ {4}Args:\n(?: {8}.+\n)+", rf"\g<0>{backend}", text, count=1, flags=re.MULTILINE)

    def custom_op(self, name: str = "", **options: Any) -> Callable[[Callable[..., Any]], Op]:
        """Makes a custom op from ``fill(arguments, results)``, which writes into the allocated results.

        Args:
            name: the name of the custom op; by default the op's name.
            options: the options of `voronerf.ops._core.custom_op`. If only the kernels know the number of rows of the
                results, pass ``fake`` too; ``fill(arguments)`` then returns the results.
        """
        memory, fake = self.allocate, options.pop("fake", None)
        if fake is not None:
            memory = functools.wraps(self.allocate)(lambda arguments: fake(arguments))
        return custom_op(name or self.name, memory, mutates=self.writes, counted=fake is not None, **options)

    def backward_op(self, name: str, forward: Op, formula: Callable[..., Any]) -> Callable[[Callable[..., None]], Op]:
        """Makes the backward of a custom op from ``fill(arguments, arriving, gradients)``.

        ``arriving`` is a named tuple of the results' gradients, None for zero. ``gradients`` is a named tuple of memory
        for the gradients of the smooth arguments, None for an unwanted gradient or an absent argument.

        Args:
            name: the name of the backward's custom op.
            forward: the custom op to differentiate, made by `custom_op`.
            formula: the reference, which gives the second derivatives.
        """
        count, width, new = len(self.results), len(self.arguments), tuple.__new__
        places = [place for place, entry in enumerate(self.arguments) if entry.name in self.smooth]
        gradients = _named("gradients", dict.fromkeys(self.smooth, Tensor | None))
        arriving = {f"of_{entry}": Tensor | None for entry in self.results}
        kind = _named("given", {**arriving, **typing.get_type_hints(self.Inputs), "wanted": Sequence[bool]})

        def memory(flat: Any) -> list[Tensor]:
            like, parts = flat[count], zip(flat[-1], [flat[count + place] for place in places])
            return [
                new_empty(like, rows_of(part), *part.shape[1:]) if want and part is not None else like.new_empty(0)
                for want, part in parts
            ]

        memory.__annotations__["flat"] = kind

        def decorate(fill: Callable[..., None]) -> Op:
            @functools.wraps(fill)
            def run(flat: Any, memories: list[Tensor]) -> None:
                arguments, parts = new(self.Inputs, flat[count:-1]), zip(memories, flat[-1], places)
                used = [part if want and arguments[place] is not None else None for part, want, place in parts]
                fill(arguments, new(self._Results, flat[:count]), new(gradients, used))

            op = custom_op(name, memory)(run)
            register_derivatives(forward, op, formula, places, width, count)
            return op

        return decorate

    def inputs(self, kind: Any, **others: Any) -> Binding:
        """Returns the binding of a compiled struct whose members are arguments.

        Args:
            kind: the struct; its members have the names of arguments or letters of their shapes.
            others: values of members with other names: the name of an argument or letter, a function of the arguments,
                or a constant.

        Raises:
            NameError: a member has no value.
        """
        return self._struct(kind, others, self.Inputs)

    def outputs(self, kind: Any, **others: str) -> Binding:
        """Returns the binding of a compiled struct whose members are the results' memory.

        Args:
            kind: the struct.
            others: member -> result, for each member whose name is not the name of its result.
        """
        return self._struct(kind, others, self._Results)

    def _struct(self, kind: Any, others: dict[str, Any], source: Any) -> Binding:
        values = [others.get(name, name) for name in kind._fields]
        names = [value for value in values if isinstance(value, str)]
        if unknown := [name for name in names if not hasattr(source, name)]:
            raise NameError(
                f"{self.name}: {kind.__name__} must only have members that are arguments, letters or results, "
                f"got {unknown}"
            )
        of_results, new, get_named = source is self._Results, tuple.__new__, operator.attrgetter(*names, "__len__")
        rest = [(place, value) for place, value in enumerate(values) if not isinstance(value, str)]

        def get(arguments: Any, results: Any) -> Any:
            *parts, _ = get_named(results if of_results else arguments)  # one call for all members; there may be many
            for place, value in rest:
                parts.insert(place, value(arguments) if callable(value) else value)
            return new(kind, parts)

        return Binding(get, ("structure", [self._binding(value, of_results).plan for value in values]))

    def _binding(self, value: Any, of_results: bool = False) -> Binding:
        """Returns the binding of a compiled function's parameter, or of a member of its structs.

        ``value`` is of one of the kinds that `compiled_op` lists for its parameters. With ``of_results``, a name that
        is both an argument and a result means the result.
        """
        if isinstance(value, Binding):
            return value
        if isinstance(value, Memory):
            shape, dtype = value.shape, value.dtype
            make = lambda args, _: new_empty(args[0], *[getattr(args, n) for n in shape], dtype=dtype)  # noqa: E731
            return Binding(make, ("memory", dtype.itemsize, shape))
        if not isinstance(value, str):
            if callable(value):
                return Binding(lambda args, _: value(args), ("function", value))
            return Binding(lambda args, _: value, ("constant", value))
        if value in self.results and (of_results or value not in self._places):
            place = [*self.results].index(value)
            alone = len(self.results) == 1
            return Binding(lambda _, results: results if alone else results[place], ("result", place))
        get = operator.attrgetter(value)
        plan: tuple[Any, ...] = ("letter", value) if value in self._letters() else ("function", get)
        if value in self._places:
            plan = "argument", self._places[value]
        elif value.endswith("_per_ray"):
            plan = "rays", self._places[value.removesuffix("_per_ray")]
        return Binding(lambda args, _: get(args), plan)

    def _result_rows(self) -> list[tuple[Any, ...]]:
        """Returns the description of the results for the compiled module."""
        known = {*self._places, *self._letters()}

        def sizes(shape: Sequence[int | str]) -> list[Any]:
            """Replaces the letters that the compiled module does not know with functions of the arguments."""
            return [
                entry if isinstance(entry, int) or entry.removesuffix("+1") in known else operator.attrgetter(entry)
                for entry in shape
            ]

        return [
            (self._places[like], dtype, self._places.get(row.condition, -1), sizes(row.shape), sizes(row.otherwise))
            for row, (like, dtype) in zip(self.results.values(), self._likes())
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
        """Makes a custom op that calls a function of the compiled module.

        A plain call on the CPU runs without Python (csrc/bindings/signature.cpp).

        Args:
            name: the name of the custom op; by default the op's name.
            function: the name of the compiled function.
            parameters: the parameters of the function except the machine. Each is the name of an argument, a result or
                a letter, a `Binding` (`inputs`, `outputs`), a `Memory`, a function of the arguments, or a constant.
            on_cuda: a function (arguments, results, machine) that fills the results on a GPU; None if the compiled
                function has the same parameters on a GPU.
            fault: a function that raises the error; it is called with the arguments if the compiled function returns
                False.
            options: the options of `custom_op`.
        """
        from voronerf.ops._core import native

        sources, on_devices = [*map(self._binding, parameters)], "cuda" in options.get("devices", ("cuda",))

        def fill(arguments: Any, results: Any) -> None:
            machine = native.machine(arguments[0]) if on_devices else native.cpu()
            if on_cuda is not None and isinstance(machine, native.compiled.Cuda):
                on_cuda(arguments, results, machine)
                return
            valid = getattr(native.compiled, function)(*[source.get(arguments, results) for source in sources], machine)
            if valid is False and fault is not None:
                fault(arguments)

        op = self.custom_op(name, **options)(functools.wraps(self.function)(fill))
        op.__module__ = f"voronerf.ops.{backends.folder(self.name)}.native"
        pack = self._results_class or self._pack
        op.plan = function, [source.plan for source in sources], self._result_rows(), pack, fault
        return op


def _size_of(ways: Sequence[tuple[int, int, int, int]]) -> Callable[[Any], int]:
    """Returns a function from the arguments to the size of a letter.

    Each entry of ``ways`` is (dimensions, place, dimension, less): if the argument at ``place`` has ``dimensions``
    dimensions, the size is that argument's size in ``dimension`` minus ``less``. The first entry that applies counts;
    the default is 0.
    """

    def size(arguments: Any) -> int:
        for dimensions, place, dimension, less in ways:
            tensor = arguments[place]
            if tensor is not None and tensor.dim() == dimensions:
                count = tensor.shape[dimension] if dimension else rows_of(tensor)
                return count - less
        return 0

    return size


def _is_per_ray(place: int) -> Callable[[Any], bool]:
    return lambda arguments: arguments[place] is not None and arguments[place].dim() > 1


def _size_in(arguments: Any, entry: int | str) -> int:
    """Returns the size for one entry of a shape."""
    if isinstance(entry, int):
        return entry
    size: int = getattr(arguments, entry.removesuffix("+1"))
    return size + 1 if entry.endswith("+1") else size


def _named(name: str, hints: dict[str, Any]) -> Any:
    make: Any = collections.namedtuple  # Any: type checkers require literal fields
    kind = make(name, hints)
    kind.__annotations__ = hints
    return kind


def _argument(name: str, hint: Any, small: bool, written: bool) -> Argument:
    rule = ""
    if typing.get_origin(hint) is typing.Annotated:
        hint, rule = typing.get_args(hint)
    options = typing.get_args(hint) if typing.get_origin(hint) in (typing.Union, types.UnionType) else [hint]
    (kind,) = (kind for kind in options if kind is not type(None))
    parsed: Any = kind
    if kind is Tensor:
        parsed = tensor_rule(name, rule)._replace(small=small, written=written)
    elif kind is int:
        low, _, high = rule.partition("..")
        parsed = int(low), int(high or MAX_COUNT)
    elif kind is float:
        parsed = tuple(float(end) for end in re.findall(r"[\d.]+", rule))
    elif kind is str:
        parsed = rule.split("|")
    return Argument(name, kind, hint is not kind, parsed, rule)


def _results(hint: Any, name: str = "result") -> tuple[Callable[[Any], Any] | None, dict[str, TensorRule]]:
    """Returns the function that packs the results for the caller (or None), and the result tensors by name."""
    if hint is type(None):
        return None, {}
    if typing.get_origin(hint) is typing.Annotated:
        return None, {name: tensor_rule(name, typing.get_args(hint)[1])}
    if hasattr(hint, "_fields"):
        fields = typing.get_type_hints(hint, include_extras=True)
        return hint._make, {name: _results(field, name)[1][name] for name, field in fields.items()}
    first, *others = typing.get_args(hint)
    if hasattr(first, "_fields"):  # a named tuple of results, then a gradient
        count = len(first._fields)
        return lambda results: (first(*results[:count]), *results[count:]), {
            **_results(first)[1],
            **_results(others[0], "gradient")[1],
        }
    names = {f"result{place}": part for place, part in enumerate((first, *others))}
    return None, {name: _results(part, name)[1][name] for name, part in names.items()}
