"""The command line, ``voronerf train | eval | ...``: a file for each command, and their table in ``main``."""

from voronerf.app.cli.main import main

__all__ = ["main"]
