"""The command line: ``voronerf train | eval | render | export | info | preload | demo | process``."""

from voronerf.cli.main import main

__all__ = ["main"]
