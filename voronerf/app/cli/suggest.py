"""Suggestions ("did you mean ...?") for command lines that do not parse."""

from __future__ import annotations

import inspect
import math
import re
import shlex
from collections.abc import Callable
from dataclasses import is_dataclass
from pathlib import Path
from typing import Any, get_args, get_type_hints

from voronerf.app.train.config import ConfigError
from voronerf.app.wording import DASHES, either, meant_number, nearest

#: Options in seconds.
SECONDS = ("budget", "checkpoint-every")
#: Path options in which the program itself expands ~.
EXPANDED = ("lpips",)
#: Quotes of text processors and web pages in several languages, which a shell does not remove.
OPENING, CLOSING = "\u201c\u201d\u201e\u2018\u2019\u201a\u00ab\u00bb", "\u201c\u201d\u2018\u2019\u00ab\u00bb"


def check_characters(name: str, command: Callable[..., int], words: list[str]) -> None:
    """Raises ConfigError for a typographic dash or quote, and for a ~ that the shell has not expanded.

    The message shows the command line as it should be typed. Paths that exist may have such characters.
    """
    if all(word.isascii() and "~" not in word for word in words):
        return
    _, options, _ = argument_names(command)
    faults: list[str] = []
    line = ["voronerf", name]  # as typed in a shell
    for word in _joined_quotes(words):
        text = word
        if is_quoted(word) and not Path(word).exists():
            faults.append(f"the quotes of {word} are not straight quotes")
            text = re.sub(f"(^|=)[{OPENING}]|[{CLOSING}]$", r"\1", word)
        if (plain := hyphenated(text)) != text and option_of(plain) in options:
            faults.append(f"the dash of {text} is not a hyphen")
            text = plain
        flag, value = re.fullmatch(r"(?s)(?:(--[a-zA-Z][^=]*)=)?(.*)", text).groups("")  # type: ignore[union-attr]
        home = re.match("~(?:/|$)", value)
        if home and option_of(flag or line[-1]) not in EXPANDED and not Path(value).exists():
            faults.append(f"{text}: a shell expands ~ only at the start of a word without quotes")
            rest = value[home.end() :]
            line += [*filter(None, [flag]), home[0] + (shlex.quote(rest) if rest else "")]
        else:
            line.append(shlex.quote(text))
    if faults:
        raise ConfigError(f"{faults[0]}; did you mean {' '.join(line)}?")


def _joined_quotes(words: list[str]) -> list[str]:
    """Returns the words; a text in typographic quotes, which the shell has split at its spaces, becomes one word."""
    result: list[str] = []
    for number, word in enumerate(words):
        is_open = result and re.match(f"(--[^=]*=)?[{OPENING}]", result[-1]) and not is_quoted(result[-1])
        if is_open and any(later.endswith(tuple(CLOSING)) for later in words[number:]):
            result[-1] += f" {word}"
        else:
            result.append(word)
    return result


def is_quoted(word: str) -> bool:
    """Returns whether a word, or the value of an option in it, begins and ends with quotes of a text processor."""
    return re.fullmatch(f"(?s)(--[^=]*=)?[{OPENING}].*[{CLOSING}]", word) is not None


def hyphenated(word: str) -> str:
    """Returns a word with ``--`` for other dashes before a letter, as in ``\u2013data``."""
    return re.sub(f"^-*[{DASHES}][-{DASHES}]*(?=[a-zA-Z])", "--", word)


def option_of(word: str) -> str:
    """Returns the name of the option in a word, without its value: "out-dir" for ``--out_dir=x``."""
    return word.partition("=")[0].removeprefix("--").replace("_", "-")


def suggest(name: str, command: Callable[..., int], words: list[str], error: str) -> str:
    """Returns "; did you mean ...?" for a command line that the parser rejected with `error`, or ""."""
    if numbers := meant_value(name, words, error):
        return f"; did you mean {numbers}?"
    arguments, options, paths = argument_names(command)
    line = [*map(hyphenated, words)]
    for word in filter(re.compile("--?[a-zA-Z]").match, [*line]):
        option, value = option_of(word), word.partition("=")[2]
        paths = [path for path in paths if path != option]
        if option not in options:
            near, place = _nearest_option(option, arguments, options), line.index(word)
            if near not in arguments[: place + 1] or not (value or line[place + 1 :]):  # arguments have an order
                return f"; did you mean --{near}?" if near and near.split()[0] in options else ""
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


def _nearest_option(option: str, arguments: list[str], options: list[str]) -> str | None:
    """Returns the nearest argument or option: "no-occupancy" for "no-ocupancy", "device cpu" for "no-gpu"."""
    without = option.removeprefix("no-")
    positive = nearest(without, [name for name in options if not name.startswith("no-")])
    if without == option or positive is None:
        return nearest(option, [*arguments, *options])
    return "device cpu" if positive == "device" else f"no-{positive}" if f"no-{positive}" in options else positive


def meant_value(name: str, words: list[str], error: str) -> str:
    """Returns an option with the numbers that its rejected value probably means, such as "--samples 64 128", or ""."""
    rule = re.match(r"--(\S+) (?:must be (an? )?(whole )?(\d*) ?number|needs (\d+) value)", error)
    if rule:
        rejected = [(rule[1], bool(rule[2]), bool(rule[3]), int(rule[4] or rule[5] or 0))]
    else:  # such as min of --budget 10 min, an unrecognised option
        rejected = [(option, True, False, 0) for option in SECONDS if " " in value_of(words, option)]
    for option, single, whole, count in rejected:
        text = re.sub(f"[{DASHES}]", "-", value_of(words, option)).lower().strip("()[]{}, ")
        parts = [text] if single else re.split(r"[\s,;x*\u00d7]+", text)
        numbers = [meant_number(part, whole=whole, seconds=option in SECONDS) for part in parts]
        if None in numbers and not single:  # such as 1,000
            numbers = [meant_number(text, whole=whole)]
        if None in numbers or count not in (0, len(numbers)):
            continue
        meant = " ".join(map(str, numbers))
        product = str(math.prod(map(int, map(str, numbers)))) if re.search(r"[x*\u00d7]", text) else None
        if name == "train" and option == "cells" and (cells := product or meant_number(text, whole=True)):
            levels = "" if {"0", "1"} & set(map(str, numbers)) else f" or, for levels, --cells {meant}"
            return f"--cells {cells}{levels}"
        return f"--{option} {meant}" + " (seconds)" * (option in SECONDS)
    return ""


def value_of(words: list[str], option: str) -> str:
    """Returns the words of an option's value, joined by spaces; "" if the option is not among the words."""
    value: list[str] = []
    inside = False
    for word in words:
        if re.match("--[a-zA-Z]", word):
            inside = option_of(word) == option
            value = [*filter(None, [word.partition("=")[2]])] if inside else value
        elif inside:
            value.append(word)
    return " ".join(value)


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
    options |= {f"no-{name}": hint for name, hint in options.items() if hint is bool and name != "help"}
    options = {name.replace("_", "-"): hint for name, hint in options.items()}
    paths = [name for name, hint in options.items() if name == "data" or Path in (hint, *get_args(hint))]
    return arguments, list(options), paths
