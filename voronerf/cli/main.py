"""Entry point: parses the command line, runs the command, turns every expected error into one line."""

from __future__ import annotations

import os
import sys
import warnings

import tyro
from rich.console import Console

from voronerf.backends import BackendUnavailable
from voronerf.cli import commands, demo
from voronerf.training.config import ConfigError
from voronerf.training.trainer import TrainingError


def main(args: list[str] | None = None) -> int:
    """Runs one command.

    Args:
        args: The command line without the program's name; default ``sys.argv[1:]``.

    Returns:
        0 when all went well, 1 for an error, 130 when training was interrupted. Errors are one line on stderr;
        with VORONERF_TRACEBACK=1 they are shown whole.
    """
    warnings.showwarning = _show_warning
    try:
        return tyro.extras.subcommand_cli_from_dict(
            {
                "train": commands.train,
                "eval": commands.evaluate_run,
                "render": commands.render,
                "info": commands.info,
                "demo": demo.demo,
            },
            prog="voronerf",
            description="Adaptive Voronoi NeRFs: one small network per Voronoi cell, trained and run as one.",
            args=args,
            config=(tyro.conf.OmitArgPrefixes,),
        )
    except (ConfigError, ValueError, OSError, ImportError, BackendUnavailable, TrainingError) as error:
        # ValueError includes the project's own SceneError and CheckpointError.
        if os.environ.get("VORONERF_TRACEBACK"):
            raise
        text = " ".join(str(error).split()) or type(error).__name__
        print(f"voronerf: error: {text}", file=sys.stderr)
        return 1


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    Console(stderr=True).print(f"voronerf: {message}", highlight=False, markup=False)


if __name__ == "__main__":
    sys.exit(main())
