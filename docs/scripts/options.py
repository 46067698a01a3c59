"""Tables of all command-line options, read from the functions and dataclasses that define them."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable, Iterator
from typing import Any, Literal, get_args, get_origin, get_type_hints

from voronerf.app.cli.parsing import field_docs, group_name
from voronerf.app.cli.program import COMMANDS
from voronerf.app.train.config import TrainConfig

HEADER = ["| option | values | default | |", "|---|---|---|---|"]


def markdown() -> str:
    """Returns the tables of docs/options.md, with a section for each command."""
    lines = []
    for name, function in COMMANDS.items():
        summary, _, arguments = inspect.cleandoc(function.__doc__ or "").partition("\n\nArgs:\n")
        lines += [f"## voronerf {name}", "", summary, ""]
        if name == "train":
            lines += [*train_tables(), "### This training", ""]
        elif TrainConfig in get_type_hints(function).values():
            lines += ["Takes the settings of `voronerf train`, and:", ""]
        lines += table(function, arguments)
    return "\n".join(lines) + "\n"


def train_tables() -> list[str]:
    """Returns the settings of a training, with a table for each group."""
    lines = []
    for group in reversed(TrainConfig.__bases__):
        lines += [f"### {group_name(group).capitalize()}", "", *HEADER, *settings(group), ""]
    return lines


def settings(kind: type) -> list[str]:
    """Returns a row for each field of a dataclass."""
    texts, kinds, prefix = field_docs(kind), get_type_hints(kind), getattr(kind, "prefix", "")
    return [
        row(f"--{dashed(prefix + f.name)}", kinds[f.name], f.default, texts[f.name]) for f in dataclasses.fields(kind)
    ]


def table(function: Callable[..., Any], arguments: str) -> list[str]:
    """Returns a table of a command's arguments."""
    texts, kinds = dict(argument_docs(arguments)), get_type_hints(function)
    marked = get_type_hints(function, include_extras=True)
    lines = []
    for name, parameter in inspect.signature(function).parameters.items():
        if kinds[name] is TrainConfig:
            continue
        if dataclasses.is_dataclass(kinds[name]):
            lines += settings(kinds[name])
            continue
        positional = parameter.kind is parameter.POSITIONAL_ONLY
        shown = next(
            (word.name for word in getattr(marked[name], "__metadata__", ()) if getattr(word, "name", None)), name
        )
        label = name.upper() if positional else f"--{dashed(shown)}"
        lines.append(row(label, kinds[name], parameter.default, texts[name]))
    return [*HEADER, *lines, ""] if lines else ["No options.", ""]


def row(label: str, kind: Any, default: Any, text: str) -> str:
    """Returns one row of a table."""
    shown = "" if default in (None, (), inspect.Parameter.empty) else f"`{words(default)}`"
    if isinstance(default, bool):
        label, shown = f"{label}` or `{label.replace('--', '--no-')}", "on" if default else "off"
    text = re.sub(r"(?<![`\w])(--[a-z][a-z-]+)", r"`\1`", " ".join(text.split()))
    return f"| `{label}` | {values(kind)} | {shown} | {escape(text)} |"


def values(kind: Any) -> str:
    """Returns the values of an option as text, from its type."""
    parts = [part for part in get_args(kind) if part is not type(None)]
    if get_origin(kind) is Literal:
        return ", ".join(f"`{word}`" for word in get_args(kind))
    if get_origin(kind) is tuple:
        return f"{values(parts[0])}s"
    if parts:
        return " or ".join(map(values, parts))
    return {int: "integer", float: "number", str: "text", bool: "", "Path": "path"}.get(kind, "path")


def words(default: Any) -> str:
    """Returns a default as typed on the command line."""
    return " ".join(map(str, default)) if isinstance(default, tuple) else str(default)


def argument_docs(arguments: str) -> Iterator[tuple[str, str]]:
    """Yields names and texts of a docstring's arguments."""
    for block in re.split(r"\n(?= {4}\w+:)", arguments):
        name, _, text = block.strip().partition(":")
        if name:
            yield name, text


def dashed(name: str) -> str:
    """Returns a setting's name on the command line."""
    return name.replace("_", "-")


def escape(text: str) -> str:
    """Escapes text for a cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    print(markdown())
