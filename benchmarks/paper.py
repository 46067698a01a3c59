"""Every table and figure of the paper by name: the command. ``paper/main.py`` says what it takes."""

import os
import sys

from paper.main import main
from paper.runs import data_folder

from voronerf.app.cli.program import EXPECTED

if __name__ == "__main__":
    # built-in scenes have no folder beside which weights for LPIPS would be found
    os.environ.setdefault("VORONERF_DATA", str(data_folder()))
    try:
        main()
    except EXPECTED as error:
        sys.exit(f"paper: error: {error}")
