"""Makes tables and figures of the paper by name. ``paper/main.py`` documents the command line."""

import os
import sys

from paper.main import main
from paper.runs import data_folder

from voronerf.app.cli.program import EXPECTED

if __name__ == "__main__":
    # LPIPS weights are looked up beside the scene's folder, which built-in scenes lack.
    os.environ.setdefault("VORONERF_DATA", str(data_folder()))
    try:
        main()
    except EXPECTED as error:
        sys.exit(f"paper: error: {error}")
