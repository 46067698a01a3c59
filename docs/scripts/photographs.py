"""Draws docs/images/photographs-*.jpg: a held-out picture of a run beside the photograph, with its scores below.

    python docs/scripts/photographs.py RUN DATA docs/images/photographs-bonsai.jpg [--view 5]

The run is one of `voronerf train --data DATA`; without --view, the view is the one whose PSNR is the median.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from voronerf import open_run
from voronerf.app.evaluate.metrics import psnr, ssim
from voronerf.app.evaluate.panels import picture_of_colour
from voronerf.app.scenes import load_scene
from voronerf.app.train.run_directory import stored_config

GAP, LINE, LONGEST = 6, 18, 480


def beside(run_folder: Path, data: Path, view: int | None) -> Image.Image:
    """The picture; prints the scores of the view and of all views."""
    config = stored_config(run_folder)
    assert config is not None
    scene = load_scene(data, downscale=config.downscale, format=config.format, kind=config.kind)
    run = open_run(run_folder, scene=scene)
    if view is None:
        scores = [each["psnr"] for each in run.evaluate()["views"]]
        view = int(np.argsort(scores)[len(scores) // 2])
    truth = scene.test.truth(view, scene.background_colour())
    drawn = run.render(view, heaviest=False).colour.clamp(0, 1)
    said = f"{float(psnr(drawn, truth)):.2f} dB, SSIM {float(ssim(drawn, truth)):.3f}"
    print(f"{run_folder}: {scene.test.names[view]}: {said}")
    pictures = {"photograph, held out": truth, f"voronerf, {said}": drawn}
    height, width = truth.shape[:2]
    scale = min(1.0, LONGEST / max(height, width))
    size = round(width * scale), round(height * scale)
    sheet = Image.new("RGB", (2 * size[0] + GAP, size[1] + LINE), "white")
    draw = ImageDraw.Draw(sheet)
    for index, (caption, picture) in enumerate(pictures.items()):
        left = index * (size[0] + GAP)
        small = Image.fromarray(picture_of_colour(picture).numpy()).resize(size, Image.Resampling.LANCZOS)
        sheet.paste(small, (left, 0))
        draw.text((left + 2, size[1] + 3), caption, fill="black", font=ImageFont.load_default())
    return sheet


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--view", type=int)
    given = parser.parse_args()
    beside(given.run, given.data, given.view).save(given.out, quality=85)
