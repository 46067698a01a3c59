"""Makes build/docs/scene.html, the page of a trained scene, unless the file exists."""

from __future__ import annotations

import json
from pathlib import Path

from voronerf.app.cli import main

FOLDER = Path(__file__).resolve().parents[2] / "build" / "docs"
STEPS = 1000
LOWEST = 25.0
"""The minimum PSNR in dB of a scene whose page is published; 1,000 steps reach 31 dB."""


def scene_page() -> Path:
    """Returns the page of the built-in scene after 1,000 steps of training.

    Raises:
        RuntimeError: A command failed, or the scene was not learnt.
    """
    page, run = FOLDER / "scene.html", FOLDER / "run"
    if not page.is_file():
        summary = run / "summary.json"
        if not summary.is_file():
            voronerf(*f"train --data builtin --steps {STEPS} --panels 1 --eval-views 4 --out".split(), str(run))
        psnr = json.loads(summary.read_text())["psnr"]
        if not psnr >= LOWEST:
            raise RuntimeError(f"{run}: a published scene must have at least {LOWEST} dB, got {psnr:.1f}")
        voronerf("export", str(run), "--web", str(page))
    return page


def voronerf(*arguments: str) -> None:
    """Runs a command of the program."""
    if main(list(arguments)) != 0:
        raise RuntimeError(f"voronerf {' '.join(arguments)} failed")


if __name__ == "__main__":
    print(scene_page())
