"""Draws docs/images/turn.webp: the run of ``voronerf demo`` beside its cells.

python docs/scripts/turn.py runs/demo
"""

from __future__ import annotations

import sys
from pathlib import Path

from PIL import Image

from voronerf.app.cli.demo import FPS, FRAMES, frames, turn
from voronerf.app.files import read_json
from voronerf.app.run import open_run
from voronerf.app.scenes.record import read_scene

OUT = Path(__file__).resolve().parents[1] / "images" / "turn.webp"


def main(folder: Path) -> None:
    """Renders a camera turn around the scene of a run and writes it as an animated picture of at most 2 MB."""
    run, summary = open_run(folder, scene=read_scene(folder / "scene.json")), read_json(folder / "summary.json")
    score = f"{summary['psnr']:.1f} dB after {run.config.budget:g} s"
    first, *others = (Image.fromarray(frame.numpy()) for frame in frames(run, turn(FRAMES), range(FRAMES), score))
    first.save(OUT, save_all=True, append_images=others, duration=round(1000 / FPS), loop=0, quality=55, method=6)
    print(f"wrote {OUT}, {OUT.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
