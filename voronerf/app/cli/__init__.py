"""The command line, ``voronerf train | eval | ...``: a file for each command, and their table in ``program``.

What a process decides for itself is set here, before torch is loaded, and not by the library.
"""

import contextlib
import ctypes
import gc
import os
import signal
import sys


def main(args: list[str] | None = None) -> int:
    """Loads the program and runs one command, see :func:`voronerf.app.cli.program.run`."""
    if sys.modules.get("torch") is None:
        _prepare()
    try:
        from voronerf.ops._core.backends import BackendUnavailable
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        return _fail("voronerf needs PyTorch 2.9 or newer, which is not installed: pip install torch")
    try:
        from voronerf.app.cli.program import run
    except BackendUnavailable as error:  # the compiled module is missing or of another version
        return _fail(str(error))
    return run(args)


def _fail(line: str) -> int:
    print(f"voronerf: error: {line}", file=sys.stderr)
    return 1


def _prepare() -> None:
    """Sets how threads wait, and what holds while the program is loaded."""
    # OpenMP's threads spin for milliseconds by default while they wait for each other, on cores that others may need:
    # beside ten busy processes a step of training takes twenty times as long. Read when torch loads its runtime.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # They spin for some ten microseconds before that: to sleep and wake takes as long, many times in a step.
    if os.environ["OMP_WAIT_POLICY"] == "passive":
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    keep_freed_memory()
    # Garbage is collected again when the command runs: while torch is loaded there is none, and to look for it takes a
    # tenth of the time.
    gc.disable()
    # Ctrl-C ends the program without a traceback while it is loaded.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def keep_freed_memory() -> None:
    """Makes the C library keep freed memory, so that the next step does not wait for the same pages again."""
    with contextlib.suppress(AttributeError, TypeError):  # a C library without these limits
        limit = ctypes.CDLL(None).mallopt
        limit(-3, 1 << 25)  # glibc's M_MMAP_THRESHOLD, which takes no more
        limit(-1, 1 << 30)  # M_TRIM_THRESHOLD
