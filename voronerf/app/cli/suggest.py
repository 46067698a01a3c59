"""Suggestions ("did you mean ...?") for command lines that do not parse."""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from voronerf.app.wording import either, nearest


def suggest(name: str, command: Callable[..., int], words: list[str], error: str) -> str:
    """Returns "; did you mean ...?" for a command line that the parser rejected with `error`, or ""."""
    arguments, options, paths = argument_names(command)
    line = list(words)
    for word in filter(re.compile("--?[a-zA-Z]").match, words):
        flag, _, value = word.partition("=")
        option = flag.removeprefix("--").replace("_", "-")
        paths = [path for path in paths if path != option]
        if option not in options:
            near, place = nearest(option, [*arguments, *options]), line.index(word)
            if near not in arguments[: place + 1] or not (value or line[place + 1 :]):  # arguments have an order
                return f"; did you mean --{near}?" if near in options else ""
            line[place : place + 1] = [value] if value else []
    rejected = error.removeprefix("Unrecognized options: ")
    if re.fullmatch("help|[0-9.]+|.*=.*", rejected):
        paths = []
    # A rejected word right after an option is probably not a path: it was meant as the value of the option, which takes
    # no value.
    if paths and rejected in line and not re.match("--[^=]*$", [name, *line][line.index(rejected)]):
        if arguments and len(paths) > 1:
            return f"; did you mean {either([f'--{path}' for path in paths])}?"
        line.insert(line.index(rejected), f"--{paths[0]}")
    return "" if line == words else f"; did you mean {shlex.join(['voronerf', name, *line])}?"


def argument_names(command: Callable[..., int]) -> tuple[list[str], list[str], list[str]]:
    """Returns the names of the positional arguments, of the options, and of the options that take a path."""
    arguments: list[str] = []
    options: dict[str, Any] = {"help": bool}
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        notes = getattr(hints[name], "__metadata__", ())
        if parameter.kind is parameter.POSITIONAL_ONLY:
            arguments.append(name)
        elif is_dataclass(hints[name]):
            prefix = getattr(hints[name], "prefix", "")
            options |= {f"{prefix}{name}": hint for name, hint in get_type_hints(hints[name]).items()}
        else:
            options[next((note.name for note in notes if getattr(note, "name", "")), name)] = hints[name]
    options |= {f"no-{name}": hint for name, hint in options.items() if hint is bool}
    options = {name.replace("_", "-"): hint for name, hint in options.items()}
    paths = [name for name, hint in options.items() if name == "data" or Path in (hint, *get_args(hint))]
    return arguments, list(options), paths
