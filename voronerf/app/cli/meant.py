"""The command line that was meant, where words do not fit a command."""

from __future__ import annotations

import inspect
import re
import shlex
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from voronerf.app.wording import either, nearest


def meant(name: str, command: Callable[..., int], words: list[str], error: str) -> str:
    """Returns "; did you mean ...?" for words of a command that its parser refuses with an error; "" for no idea."""
    arguments, options, paths = named(command)
    line = list(words)
    for word in filter(re.compile("--?[a-zA-Z]").match, words):
        flag, _, value = word.partition("=")
        option = flag.removeprefix("--").replace("_", "-")
        paths = [path for path in paths if path != option]
        if option not in options:
            near, at = nearest(option, [*arguments, *options]), line.index(word)
            if near not in arguments[: at + 1] or not (value or line[at + 1 :]):  # the order of arguments counts
                return f"; did you mean --{near}?" if near in options else ""
            line[at : at + 1] = [value] if value else []
    alone = error.removeprefix("Unrecognized options: ")
    if re.fullmatch("help|[0-9.]+|.*=.*", alone):
        paths = []
    # A word after an option is no path but what somebody gave to a switch.
    if paths and alone in line and not re.match("--[^=]*$", [name, *line][line.index(alone)]):
        if arguments and len(paths) > 1:
            return f"; did you mean {either([f'--{path}' for path in paths])}?"
        line.insert(line.index(alone), f"--{paths[0]}")
    return "" if line == words else f"; did you mean {shlex.join(['voronerf', name, *line])}?"


def named(command: Callable[..., int]) -> tuple[list[str], list[str], list[str]]:
    """Returns the names of the arguments without an option, of the options, and of the options that take a path."""
    arguments: list[str] = []
    options: dict[str, Any] = {"help": bool}
    hints = get_type_hints(command, include_extras=True)
    for name, parameter in inspect.signature(command).parameters.items():
        notes = getattr(hints[name], "__metadata__", ())
        if parameter.kind is parameter.POSITIONAL_ONLY:
            arguments.append(name)
        elif is_dataclass(hints[name]):
            options |= get_type_hints(hints[name])
        else:
            options[next((note.name for note in notes if getattr(note, "name", "")), name)] = hints[name]
    options |= {f"no-{name}": hint for name, hint in options.items() if hint is bool}
    options = {name.replace("_", "-"): hint for name, hint in options.items()}
    paths = [name for name, hint in options.items() if name == "data" or Path in (hint, *get_args(hint))]
    return arguments, list(options), paths
