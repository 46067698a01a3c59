"""``voronerf`` and ``python -m voronerf``: the command line."""

import sys


def main() -> int:
    """Runs the command line; without the extra ``app`` it exits with one line."""
    try:
        from voronerf.app import require

        require("matplotlib", "rich", "tyro")
    except ImportError as error:
        sys.exit(f"voronerf: error: {error}")
    from voronerf.app.cli import main as command

    return command()


if __name__ == "__main__":
    sys.exit(main())
