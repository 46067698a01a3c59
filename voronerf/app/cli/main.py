"""Entry point: parses the command line, runs the command, turns every expected error into one line."""

from __future__ import annotations

import contextlib
import functools
import gc
import inspect
import itertools
import os
import re
import signal
import sys
import threading
import unicodedata
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TextIO

import torch
import tyro
from rich.console import Console

from voronerf.app.cli import commands, compare, demo, export, info, view
from voronerf.app.cli.display import one_line
from voronerf.app.train.config import ConfigError, TrainConfig
from voronerf.app.train.progress import TrainingError
from voronerf.app.train.run_directory import check_stored_paths, read_config, stored_config
from voronerf.ops._core.backends import BackendUnavailable
from voronerf.town import cli_editing as editing
from voronerf.town import cli_update as update
from voronerf.town.distributed.group import RankLost, may_tell, own_rank

#: Errors that a user can cause; they are printed as one line. ValueError includes SceneError and CheckpointError.
EXPECTED = (
    *(ConfigError, TrainingError, BackendUnavailable, RankLost, ValueError, OSError, ImportError),
    *(MemoryError, torch.OutOfMemoryError),
)

#: What messages say when a CPU has no memory left: RuntimeErrors of torch, for a tensor or a thread, and SystemErrors
#: of Python, for an import.
NO_MEMORY = (
    *("can't allocate memory", "Cannot allocate memory", "not enough memory", "bad_alloc", "can't start new thread"),
    *("error return without exception set", "returned NULL without setting an exception"),
)

#: Printed before a training without any options.
WHAT_TO_TRY = """This trains the built-in scene for 480 s, into runs/. Ctrl-C stops it. Other things to try:
  voronerf train --budget 60                the same for a minute
  voronerf train --data DIR --downscale 4   your scene: Blender, transforms.json, COLMAP or LLFF
  voronerf train --view                     watch it in a browser
  voronerf demo                             one network against 64 cells, in a built-in city
  voronerf train --help                     every option"""

#: What ``voronerf NAME`` runs; arguments and docstring of each function are its options and its help.
COMMANDS: dict[str, Callable[..., int]] = {
    "train": commands.train,
    "eval": commands.evaluate_run,
    "render": commands.render,
    "export": export.export,
    "join": editing.join,
    "cut": editing.cut,
    "place": editing.place,
    "update": update.update,
    "view": view.view,
    "compare": compare.compare,
    "info": info.info,
    "preload": commands.preload,
    "demo": demo.demo,
    "process": commands.process,
}


def main(args: list[str] | None = None) -> int:
    """Runs one command.

    Args:
        args: The command line without the program's name; default ``sys.argv[1:]``.

    Returns:
        0 when all went well, 1 for an error, 130 when training was stopped. Errors are one line on stderr;
        with VORONERF_TRACEBACK=1 they are shown whole.
    """
    if not gc.isenabled():  # see voronerf/__init__.py
        gc.freeze()
        gc.enable()
    warnings.showwarning = _show_warning
    threading.excepthook = _show_thread_error
    if own_rank() == 0:
        return _run(args, sys.stderr)
    # Of the ranks that torchrun starts the first one speaks, and another one only to say what went wrong on it.
    told = sys.stderr
    with open(os.devnull, "w") as null, contextlib.redirect_stdout(null), contextlib.redirect_stderr(null):
        return _run(args, told)


@contextlib.contextmanager
def _exit_on_sigterm() -> Iterator[None]:
    """A context in which SIGTERM unwinds the stack, so that a command takes away what it has half written."""
    here = threading.current_thread() is threading.main_thread()
    if not here or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, lambda number, frame: sys.exit(128 + number))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _run(args: list[str] | None, told: TextIO) -> int:
    """:func:`main`, which says on ``told`` what went wrong."""
    args = sys.argv[1:] if args is None else args
    if args[:1] and args[0] in ("join", "cut", "place", "update"):
        with _exit_on_sigterm():
            return _run_command(args, told)
    return _run_command(args, told)


def _run_command(args: list[str], told: TextIO) -> int:
    """:func:`_run` of given words."""
    try:
        for word in args:  # the parser shows what it does not take as it came
            if any(unicodedata.category(char) == "Cc" for char in word):
                raise ConfigError(f"arguments must have no control characters, got {word}")
        return tyro.extras.subcommand_cli_from_dict(
            {**COMMANDS, "train": _train_command(args)},
            prog="voronerf",
            description="Adaptive Voronoi NeRFs: one small network per Voronoi cell, trained and run as one.",
            args=args,
            config=(tyro.conf.OmitArgPrefixes,),
        )
    except KeyboardInterrupt:
        print("voronerf: interrupted", file=told)
        return 130
    except EXPECTED as error:
        if os.environ.get("VORONERF_TRACEBACK"):
            raise
        if may_tell(error):
            print(f"voronerf: error: {one_line(str(error)) or type(error).__name__}", file=told)
        return 1
    except (RuntimeError, SystemError) as error:
        text = str(error)
        if os.environ.get("VORONERF_TRACEBACK") or not any(sign in text for sign in NO_MEMORY):
            raise
        asked = re.search(r"tried to allocate (\d+) bytes", text)
        size = f", {int(asked[1]) / 2**30:.1f} GiB were asked for" if asked else ""
        print(f"voronerf: error: not enough memory{size}; try a smaller --width, --rays or --samples", file=told)
        return 1


def _train_command(args: list[str]) -> Callable[..., int]:
    """The function behind ``train``; its defaults are the settings of --config, or for --resume those of the run."""
    if args == ["train"]:
        for line in WHAT_TO_TRY.splitlines():
            commands.say(line)
    file, out = _given_path(args, "--config"), _given_path(args, "--out")
    if "train" not in args[:1] or (file is None and "--resume" not in args):
        return commands.train
    if file is not None and "--resume" in args:
        raise ConfigError("--config must be left out with --resume, which goes on with the settings of the run")
    if file is not None and not file.is_file():
        raise ConfigError(f"--config {file}: there is no such file")
    stored = read_config(file) if file is not None else None if out is None else stored_config(out)
    folder = out if file is None else file.parent
    if folder is None or stored is None:
        return commands.train

    def given(name: str) -> bool:
        return any(word == f"--{name}" or word.startswith(f"--{name}=") for word in args)

    check_stored_paths(
        folder, data=None if given("data") else stored.data, lpips=None if given("lpips") else stored.lpips
    )
    # A given --steps replaces a stored budget and the other way round; the number that is set here is replaced in turn.
    length = {name for name in ("budget", "steps") if given(name)}
    if length == {"steps"} and stored.budget is not None:
        stored = replace(stored, budget=None, steps=sys.maxsize)
    elif length == {"budget"} and stored.steps is not None:
        stored = replace(stored, budget=sys.float_info.max, steps=None)

    @functools.wraps(commands.train)
    def train(config: TrainConfig = stored, **others: Any) -> int:
        return commands.train(config, **others)

    signature = inspect.signature(commands.train)
    first = signature.parameters["config"].replace(default=stored)
    train.__signature__ = signature.replace(  # type: ignore[attr-defined]
        parameters=[first, *list(signature.parameters.values())[1:]]
    )
    return train


def _given_path(args: list[str], option: str) -> Path | None:
    """The value of an option that is a path, or None."""
    found = next((after for word, after in itertools.pairwise(args) if word == option), None)
    found = next((word.removeprefix(f"{option}=") for word in args if word.startswith(f"{option}=")), found)
    return None if found is None else Path(found)


def _show_thread_error(args: threading.ExceptHookArgs) -> None:
    """A thread that cannot start for lack of memory prints nothing: whoever waits for it reports the error."""
    if not isinstance(args.exc_value, (MemoryError, SystemError)):
        threading.__excepthook__(args)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    Console(stderr=True, soft_wrap=True).print(f"voronerf: {one_line(str(message))}", highlight=False, markup=False)


if __name__ == "__main__":
    sys.exit(main())
