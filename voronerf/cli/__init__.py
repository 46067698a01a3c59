"""The command line: ``voronerf train | eval | render | info | demo``."""

from voronerf.cli.main import main

__all__ = ["main"]
