"""The command line, ``voronerf train | eval | ...``: one file per command, and the table of commands in ``program``.

Process-wide settings are made here, before torch is loaded; the library itself makes none.
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
    except BackendUnavailable as error:  # the compiled module is missing or has another version
        return _fail(str(error))
    return run(args)


def _fail(line: str) -> int:
    print(f"voronerf: error: {line}", file=sys.stderr)
    return 1


def _prepare() -> None:
    """Sets up the process before torch is imported: OpenMP wait policy, malloc limits, no GC, quiet Ctrl-C."""
    # By default, waiting OpenMP threads spin for milliseconds on cores that other processes may need: beside ten busy
    # processes a training step takes twenty times as long. OpenMP reads the variable when torch loads its runtime.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # Threads still spin for some ten microseconds before they sleep, since going to sleep and waking takes as long.
    if os.environ["OMP_WAIT_POLICY"] == "passive":
        os.environ.setdefault("GOMP_SPINCOUNT", "1000")
    keep_freed_memory()
    # Loading torch makes no garbage, and the collector would take a tenth of the loading time. `program.run` enables
    # it again.
    gc.disable()
    # During loading, Ctrl-C ends the program without a traceback.
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def keep_freed_memory() -> None:
    """Makes the C library keep freed memory, so that later steps do not page-fault the same memory again."""
    with contextlib.suppress(AttributeError, TypeError):  # a C library without these limits
        limit = ctypes.CDLL(None).mallopt
        limit(-3, 1 << 25)  # glibc's M_MMAP_THRESHOLD, at its maximum
        limit(-1, 1 << 30)  # M_TRIM_THRESHOLD
