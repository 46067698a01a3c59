"""The command line: ``voronerf train | eval | render | info | preload | demo``."""

from voronerf.cli.main import main

__all__ = ["main"]
