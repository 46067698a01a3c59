"""Makes build/docs/scene.html, a page of a scene that is trained for it; once, unless it is removed."""

from __future__ import annotations

from pathlib import Path

from voronerf.app.cli import main

FOLDER = Path(__file__).resolve().parents[2] / "build" / "docs"


def scene_page() -> Path:
    """The page of a built-in scene after twelve seconds of training."""
    page, run = FOLDER / "scene.html", FOLDER / "run"
    if not page.is_file():
        training = f"train --data builtin --budget 12 --panels 1 --eval-views 4 --out {run}".split()
        for command in (
            [] if (run / "summary.json").is_file() else [training],
            [["export", str(run), "--web", str(page)]],
        ):
            for arguments in command:
                if main(arguments) != 0:
                    raise RuntimeError(f"voronerf {' '.join(arguments)} failed")
    return page


if __name__ == "__main__":
    print(scene_page())
