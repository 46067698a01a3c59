"""The command line: ``voronerf train | eval | render | export | view | compare | info | preload | demo | process``."""

from voronerf.app.cli.main import main

__all__ = ["main"]
