"""Entry point: parses the command line, runs the command, prints every expected error as one line."""

from __future__ import annotations

import contextlib
import gc
import os
import re
import select
import shlex
import signal
import sys
import threading
import unicodedata
import warnings
from collections.abc import Callable

import torch
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from voronerf import __version__
from voronerf.app.cli.compare import compare
from voronerf.app.cli.demo import demo
from voronerf.app.cli.display import console, exit_on_sigterm, one_line, say
from voronerf.app.cli.editing import cut, join, place
from voronerf.app.cli.eval import evaluate_run
from voronerf.app.cli.export import export
from voronerf.app.cli.info import info
from voronerf.app.cli.parsing import parse
from voronerf.app.cli.process import process
from voronerf.app.cli.regions import regions
from voronerf.app.cli.render import render
from voronerf.app.cli.suggest import argument_names, check_characters, hyphenated
from voronerf.app.cli.train import WHAT_TO_TRY, train, with_stored_settings, without_early_resume
from voronerf.app.cli.view import view
from voronerf.app.train.config import ConfigError
from voronerf.app.train.loop import TrainingError
from voronerf.app.wording import nearest
from voronerf.nerf.distributed import PeerLost
from voronerf.ops._core.backends import BackendUnavailable

#: Errors that a user can cause; they are printed as one line. ValueError includes SceneError and CheckpointError.
EXPECTED = (
    *(ConfigError, TrainingError, BackendUnavailable, ValueError, OSError, ImportError, PeerLost),
    *(MemoryError, torch.OutOfMemoryError),
)

#: Texts of errors for exhausted CPU memory: RuntimeErrors of torch for a tensor or a thread, SystemErrors of Python
#: for an import.
NO_MEMORY = (
    *("can't allocate memory", "Cannot allocate memory", "not enough memory", "bad_alloc", "can't start new thread"),
    *("error return without exception set", "returned NULL without setting an exception"),
)

#: The function that ``voronerf NAME`` runs; its arguments are the options, its docstring is the help.
COMMANDS: dict[str, Callable[..., int]] = {
    "train": train,
    "eval": evaluate_run,
    "render": render,
    "export": export,
    "regions": regions,
    "join": join,
    "cut": cut,
    "place": place,
    "view": view,
    "compare": compare,
    "info": info,
    "demo": demo,
    "process": process,
}


def run(args: list[str] | None = None) -> int:
    """Runs one command.

    Args:
        args: The command line without the program's name; default ``sys.argv[1:]``.

    Returns:
        0 for success, 1 for an error, 130 if training was stopped, 141 if the reader of the output has closed it.
        Errors are one line on stderr; with VORONERF_TRACEBACK=1 they have a traceback.
    """
    args = sys.argv[1:] if args is None else args
    if not gc.isenabled():  # see voronerf/app/cli/__init__.py
        gc.freeze()
        gc.enable()
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)
    warnings.showwarning = _show_warning
    threading.excepthook = _show_thread_error
    with contextlib.nullcontext() if args[:1] == ["train"] else exit_on_sigterm():  # a training ends by a checkpoint
        try:
            status = _run(args)
        except SystemExit:
            if not _nobody_reads():
                raise
            status = 0
        if not _nobody_reads():
            return status
        # At exit Python flushes stdout, and would print a traceback for the closed pipe.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return status or 128 + 13  # SIGPIPE, as for `voronerf train --help | head`


def _nobody_reads() -> bool:
    """Returns whether stdout is a pipe whose reader has closed it."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), 0)
        return bool(poll.poll(0))  # reports errors only
    except (AttributeError, OSError, ValueError):  # Windows, no stdout, or a stdout without a file descriptor
        return False


def _run(args: list[str]) -> int:
    """Parses the command line and runs the command; prints errors to stderr."""
    if args == ["train"]:
        for line in WHAT_TO_TRY.splitlines():
            say(line)
    try:
        for word in args:  # the parser prints unknown words without escaping them
            if any(unicodedata.category(char) == "Cc" for char in word):
                raise ConfigError(f"arguments must have no control characters, got {word}")
        return parse_command(*args)()
    except KeyboardInterrupt:
        print("voronerf: interrupted", file=sys.stderr)
        return 130
    except EXPECTED as error:
        if isinstance(error, BrokenPipeError) and _nobody_reads():
            return 0
        if os.environ.get("VORONERF_TRACEBACK"):
            raise
        message = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else str(error)
        print(f"voronerf: error: {one_line(message) or type(error).__name__}", file=sys.stderr)
        return 1
    except (RuntimeError, SystemError) as error:
        text = str(error)
        if os.environ.get("VORONERF_TRACEBACK") or not any(sign in text for sign in NO_MEMORY):
            raise
        allocation = re.search(r"tried to allocate (\d+) bytes", text)
        size = f" for {int(allocation[1]) / 2**30:.1f} GiB" if allocation else ""
        print(f"voronerf: error: not enough memory{size}; try a smaller --width, --rays or --samples", file=sys.stderr)
        return 1


def parse_command(name: str = "--help", *words: str) -> Callable[[], int]:
    """Returns the command of a command line, with its arguments bound.

    Raises:
        ConfigError: The command or one of its arguments is unknown.
    """
    if name in ("-h", "--help"):
        return _show_commands
    if name == "--version":
        print(f"voronerf {__version__}")
        return lambda: 0
    if name not in COMMANDS:
        plain = hyphenated(name)
        word = plain.lstrip("-")
        if plain.startswith("--") and word != "help" and word.partition("=")[0] in argument_names(train)[1]:
            hint = f"did you mean {shlex.join(['voronerf', 'train', plain, *map(hyphenated, words)])}?"
        elif near := nearest(word, [*COMMANDS, "help", "version"]):
            hint = f"did you mean {near if near in COMMANDS else f'voronerf --{near}'}?"
        else:
            hint = "see voronerf --help"
        raise ConfigError(f"there is no command {name}; {hint}")
    command = COMMANDS[name]
    if name == "train":
        words = tuple(without_early_resume(list(words)))
    check_characters(name, command, list(words))
    return parse(name, with_stored_settings(command, list(words)) if name == "train" else command, words)


def _show_commands() -> int:
    """Prints the commands, each with the first paragraph of its docstring."""
    table = Table(box=None, show_header=False, pad_edge=False)
    for name, command in COMMANDS.items():
        table.add_row(f"  {name}", escape(" ".join((command.__doc__ or "").partition("\n\n")[0].split())))
    print(
        "usage: voronerf COMMAND ...\n\nMany small networks, one per Voronoi cell of space, trained and run as one.\n"
    )
    console.print(table, soft_wrap=False)
    print("\nvoronerf COMMAND --help shows the options of a command, voronerf --version shows the version.")
    return 0


def _show_thread_error(args: threading.ExceptHookArgs) -> None:
    """Prints a thread's traceback, except for lack of memory, which the waiting thread reports."""
    if not isinstance(args.exc_value, (MemoryError, SystemError)):
        threading.__excepthook__(args)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    Console(stderr=True, soft_wrap=True).print(f"voronerf: {one_line(str(message))}", highlight=False, markup=False)
