"""``python -m voronerf``: the command line, for torchrun too."""

import sys

from voronerf.cli import main

if __name__ == "__main__":
    sys.exit(main())
