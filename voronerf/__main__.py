"""``python -m voronerf``: the command line."""

import sys

from voronerf.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
