"""The command line in an attempt: what it prints, and whether that is a clear refusal."""

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

# Not in every attempt again; and a file that changes meanwhile then changes no attempt.
every_op = [module.name for module in pkgutil.walk_packages(ops.__path__, "voronerf.ops.")]
for slow in ("matplotlib.pyplot", "imageio_ffmpeg", "rich._emoji_codes", *every_op):
    importlib.import_module(slow)

LONGEST = 1000


def run(*args: str | Path) -> tuple[int, str, str]:
    """The exit status of a command, and what it prints to stdout and stderr."""
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            status = main([str(arg) for arg in args])
        except SystemExit as error:
            status = error.code if isinstance(error.code, int) else 1
    return status, out.getvalue(), err.getvalue()


def judged(*args: str | Path) -> str:
    """RIGHT where a command ends well, REFUSED where it says in one line why not.

    Raises:
        Failed: When what it prints is unclear, or a terminal would obey it.
    """
    status, out, err = run(*args)
    spoken = " ".join(map(str, args))
    lines = err.splitlines()
    if any(not char.isprintable() and char != "\n" for char in out + err):
        raise Failed(f"a terminal would obey what this prints: {spoken}: {err!r:.300}")
    if status == 0:
        return RIGHT
    if status == 2:  # the parser of options explains itself in a box
        return REFUSED
    wrong = [line for line in lines if len(line) > LONGEST or not re.match(r"voronerf: |[^:]*: [0-9]+ of ", line)]
    if status != 1 or not lines or wrong or not lines[-1].startswith("voronerf: error: "):
        raise Failed(f"not one clear line with status {status}: {spoken}: {err!r:.400}")
    return REFUSED
