"""Parses a command line into a command and its arguments, by tyro; error messages are one line."""

from __future__ import annotations

import ast
import contextlib
import functools
import inspect
import io
import itertools
import operator
import re
import types
from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import tyro
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from voronerf.app.cli.suggest import suggest
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.wording import did_you_mean, either

RULES = ConstructorRegistry()
#: Names of the number types in error messages.
NUMBERS = {int: "a whole number", float: "a number"}
#: Defaults that the help does not show.
NOTHING = (None, (), inspect.Parameter.empty)
#: ANSI colour codes of a terminal.
COLOURS = re.compile(r"\x1b\[[0-9;]*m")


def parse(name: str, command: Callable[..., int], words: Sequence[str]) -> Callable[[], int]:
    """Returns the command with the arguments in ``words`` bound; for ``--help``, prints the help and exits.

    Raises:
        ConfigError: The words do not parse. The message is one line.
    """

    @functools.wraps(command)
    def bind(*arguments: Any, **options: Any) -> Callable[[], int]:
        return functools.partial(command, *arguments, **options)

    hints, signature = get_type_hints(command, include_extras=True), inspect.signature(command)
    bind.__annotations__ = {k: _argument(hints[k], part.default) for k, part in signature.parameters.items()}
    bind.__doc__ = re.sub(r"\n {12}", " ", command.__doc__ or "")  # tyro would keep these line breaks
    bind.__signature__ = signature  # type: ignore[attr-defined]
    del bind.__wrapped__  # tyro would read its annotations
    stderr = io.StringIO()
    try:
        with contextlib.redirect_stderr(stderr):
            markers = (tyro.conf.OmitArgPrefixes, tyro.conf.PositionalMetavarFromFieldName)
            return tyro.cli(bind, prog=f"voronerf {name}", args=words, config=markers, registry=RULES)
    except SystemExit as stop:
        if stop.code == 0:
            raise
        line = in_a_line(stderr.getvalue())
        end = "" if line.endswith("?") else suggest(name, command, list(words), line) or f"; see voronerf {name} --help"
        raise ConfigError(line + end) from None


def in_a_line(box: str) -> str:
    """Returns the message in an error box of tyro as one line."""
    _, *rows = (line[2:].rstrip(" │") for line in COLOURS.sub("", box).splitlines())
    parts = [[*part] for is_rule, part in itertools.groupby(rows, lambda row: row[:1] in ("─", "-")) if not is_rule]
    if missing := re.fullmatch("Missing from voronerf (.*):", parts[0][0]):  # lists each argument with its help
        names = [row.strip() for row in parts[0][1:] if re.match(r" {4}\S", row)]
        return f"{missing[1]} needs {' and '.join([', '.join(names[:-1]), names[-1]] if names[1:] else names)}"
    message = re.sub("^Error parsing ([^:]+):", r"\1", " ".join(" ".join(parts[0]).split())).rstrip(".")
    return re.sub(r"^Missing value for argument '(-*)(.*)'\. Expected (\d+) values$", too_few_values, message)


def too_few_values(match: re.Match[str]) -> str:
    """Returns the message for an argument with too few values."""
    dashes, name, count = match.groups()
    return f"{dashes + name if dashes else name.upper()} needs {'a value' if count == '1' else f'{count} values'}"


def _argument(hint: Any, default: Any) -> Any:
    """Returns an argument's type for tyro: a class of settings gets a group, and empty defaults are not shown."""
    if hint is TrainConfig:
        return Annotated[hint, tyro.conf.arg(name="")]
    return Annotated[hint, tyro.conf.arg(help_behavior_hint="")] if default in NOTHING else hint


@RULES.struct_rule
def settings(info: StructTypeInfo) -> StructConstructorSpec | None:
    """Tells tyro how to show dataclasses: a box per group of training settings, and help texts without line breaks."""
    if info.type is TrainConfig:
        defaults = vars(info.default) if isinstance(info.default, TrainConfig) else {}
        groups = {
            base: base(**{field.name: defaults[field.name] for field in fields(base) if defaults})
            for base in reversed(TrainConfig.__bases__)
        }
        return StructConstructorSpec(
            lambda **parts: TrainConfig(**{k: v for part in parts.values() for k, v in vars(part).items()}),
            tuple(StructFieldSpec(group_name(base), base, default) for base, default in groups.items()),
        )
    if not is_dataclass(info.type):
        return None
    kind, prefix = info.type, getattr(info.type, "prefix", "")
    texts, hints, specs = field_docs(kind), get_type_hints(kind), []
    for field in fields(kind):
        default = getattr(info.default, field.name, field.default)
        name = f"{prefix}{field.name}"
        specs.append(StructFieldSpec(name, _argument(hints[field.name], default), default, texts[field.name]))
    return StructConstructorSpec(
        lambda **parts: kind(**{name.removeprefix(prefix): value for name, value in parts.items()}), tuple(specs)
    )


@RULES.primitive_rule
def values(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec | None:
    """Tells tyro how to parse numbers, lists of numbers, choices and optional values.

    Error messages state the expected form and the given value.
    """
    kind, origin, parts = info.type, get_origin(info.type), get_args(info.type)
    if kind in NUMBERS:
        return _spec(1, kind.__name__.upper(), NUMBERS[kind], lambda words: kind(words[0]))
    if origin is tuple and parts[0] in NUMBERS:
        name = parts[0].__name__.upper()
        if parts[-1] is Ellipsis:
            rule = f"{NUMBERS[parts[0]].split(' ', 1)[1]}s"
            return _spec("*", f"[{name} ...]", rule, lambda words: tuple(map(parts[0], words)))
        metavar = " ".join([name] * len(parts))
        return _spec(len(parts), metavar, f"{len(parts)} numbers", lambda words: tuple(map(parts[0], words)))
    if origin is Literal:
        return _spec(1, f"{{{','.join(parts)}}}", either(parts), lambda words: dict(zip(parts, parts))[words[0]], parts)
    if origin in (Union, types.UnionType) and type(None) in parts:
        inner = functools.reduce(operator.or_, (part for part in parts if part is not type(None)))
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(inner, info.markers))
        if not isinstance(spec, PrimitiveConstructorSpec):
            return None
        read = spec.instance_from_str
        if len(parts) > 2:
            names = spec.metavar.translate({ord(c): None for c in "{}"}).replace("|", " or ")
            rule = re.sub(r"(FLOAT|INT)( \1)+", lambda match: f"{len(match[0].split())} numbers", names)
            read = _spec(spec.nargs, spec.metavar, rule, read).instance_from_str
        return replace(
            spec,
            instance_from_str=lambda words: None if words == ["None"] else read(words),
            str_from_instance=lambda value: [] if value is None else spec.str_from_instance(value),
        )
    return None


def _spec(
    count: int | tuple[int, ...] | Literal["*"],
    metavar: str,
    rule: str,
    read: Callable[[list[str]], Any],
    choices: Sequence[str] = (),
) -> PrimitiveConstructorSpec:
    """Returns tyro's description of a value of ``count`` words; error messages say that it must be ``rule``."""

    def value(words: list[str]) -> Any:
        try:
            return read(words)
        except (KeyError, ValueError):
            text = " ".join(words)
            raise ValueError(f"must be {rule}, got {text!r}{did_you_mean(text, choices)}") from None

    def shown(instance: Any) -> list[str]:
        return [str(part) for part in (instance if isinstance(instance, tuple) else (instance,))]

    return PrimitiveConstructorSpec(count, metavar, value, lambda instance: True, shown)


def group_name(kind: type) -> str:
    """Returns the name of a group of settings in the help, "scene" for `SceneSettings`."""
    return kind.__name__.removesuffix("Settings").lower()


def field_docs(kind: type) -> dict[str, str]:
    """Returns the docstrings below the fields of a dataclass and of its bases, each as one line."""
    classes = [ast.parse(inspect.getsource(base)).body[0] for base in reversed(kind.__mro__) if is_dataclass(base)]
    return {
        before.target.id: " ".join(str(after.value.value).split())
        for tree in classes
        if isinstance(tree, ast.ClassDef)
        for before, after in itertools.pairwise(tree.body)
        if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name)
        if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    }
