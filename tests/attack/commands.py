"""Runs the command line in an attempt, and checks that its output is a clear refusal."""

from __future__ import annotations

import contextlib
import importlib
import io
import pkgutil
import re
from pathlib import Path

from attempts import REFUSED, RIGHT, Failed

from voronerf import ops
from voronerf.app.cli import main

# These modules are imported before the forks, for speed and so that changed files do not affect later attempts.
every_op = [module.name for module in pkgutil.walk_packages(ops.__path__, "voronerf.ops.")]
for slow in ("matplotlib.pyplot", "imageio_ffmpeg", "rich._emoji_codes", *every_op):
    importlib.import_module(slow)

LONGEST = 1000


def run(*args: str | Path) -> tuple[int, str, str]:
    """Runs a command; returns its exit status, stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main([str(arg) for arg in args])
        except SystemExit as error:
            status = error.code if isinstance(error.code, int) else 1
    return status, out.getvalue(), err.getvalue()


def judged(*args: str | Path) -> str:
    """Runs a command; returns RIGHT if it succeeds, and REFUSED if it prints one clear error line.

    Raises:
        Failed: The output is unclear, or has control characters that a terminal would execute.
    """
    status, out, err = run(*args)
    spoken = " ".join(map(str, args))
    lines = err.splitlines()
    if any(not char.isprintable() and char != "\n" for char in out + err):
        raise Failed(f"a terminal would obey what this prints: {spoken}: {err!r:.300}")
    if status == 0:
        return RIGHT
    if status == 2:  # the option parser prints its error in a box
        return REFUSED
    wrong = [line for line in lines if len(line) > LONGEST or not re.match(r"voronerf: |[^:]*: [0-9]+ of ", line)]
    if status != 1 or not lines or wrong or not lines[-1].startswith("voronerf: error: "):
        raise Failed(f"not one clear line with status {status}: {spoken}: {err!r:.400}")
    return REFUSED
