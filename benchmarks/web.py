"""Compares web pages of trained runs, in Chromium with WebGPU on the CPU, with the pictures of `Run.render`.

    python benchmarks/web.py --runs runs/lego runs/bonsai runs/demo --pixels 100 --json benchmarks/results/web.json

It needs Debian's packages chromium and chromium-driver, and selenium.
"""

from __future__ import annotations

import base64
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from harness import write_results
from numpy.typing import NDArray
from selenium import webdriver
from torch import Tensor

from voronerf.app.cli.opening import Opening
from voronerf.app.files import json_text, read_json
from voronerf.app.run import Run
from voronerf.app.web import export_web
from voronerf.nerf import Cameras

FLAGS = """--headless=new --no-sandbox --enable-unsafe-webgpu --use-webgpu-adapter=swiftshader
--enable-features=Vulkan --use-vulkan=swiftshader --use-angle=swiftshader --no-first-run
--disable-background-networking --disable-component-update --hide-scrollbars --window-size=800,800"""
PICTURE = """
const [camera, done] = arguments;
voronerf.started.then(() => voronerf.picture(camera)).then(
  (bytes) => done(btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""))),
  (error) => done(`error: ${error}`));
"""
VIEWS = 5
#: The page's window while pictures are requested, so small that drawing the window takes no time.
SMALL = {"width": 40, "height": 40, "deviceScaleFactor": 1, "mobile": False}


@dataclass(frozen=True)
class Options:
    """The runs and their settings."""

    runs: tuple[Path, ...]
    """Run directories. A row is named after its directory."""
    data: str | None = None
    """The scene folder. Default: as in training."""
    pixels: int = 100
    """The largest number of pixels along the longer side of the compared pictures."""
    json: Path | None = None
    """The JSON file that the results are added to. Default: results are only printed."""


@contextmanager
def browser() -> Iterator[Any]:
    """Opens Chromium with an empty profile."""
    with tempfile.TemporaryDirectory() as profile:
        options = webdriver.ChromeOptions()
        options.binary_location = shutil.which("chromium") or ""
        for flag in (*FLAGS.split(), f"--user-data-dir={profile}"):
            options.add_argument(flag)
        driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
        driver.set_script_timeout(600)
        try:
            yield driver
        finally:
            driver.quit()


def first_picture(driver: Any, page: Path) -> float:
    """Opens a page; returns the seconds until it shows its scene."""
    started = time.perf_counter()
    driver.get(page.resolve().as_uri())
    while not driver.execute_script("return document.getElementById('still').hidden"):
        time.sleep(0.02)
    return time.perf_counter() - started


def drawn(driver: Any, cameras: Cameras, index: int) -> NDArray[np.float64]:
    """Returns the page's picture [h, w, 3] in 0..1 for a camera."""
    width, height = cameras.size(index)
    fx, fy, cx, cy = cameras.intrinsics[index].tolist()
    pose = cameras.poses[index, :3].flatten().tolist()
    camera = {"pose": pose, "focal": [fx, fy], "centre": [cx, cy], "width": width, "height": height}
    encoded = driver.execute_async_script(PICTURE, camera)
    if encoded.startswith("error"):
        raise RuntimeError(encoded)
    return np.frombuffer(base64.b64decode(encoded), np.uint8).reshape(height, width, 4)[..., :3] / 255


def photograph(run: Run, index: int, pinhole: Cameras) -> tuple[Tensor, Tensor]:
    """Returns a held-out photograph [h, w, 3] undistorted to a pinhole camera, and the mask [h, w] of valid pixels."""
    cameras, truth = run.scene.test.cameras, run.scene.test.truth(index, run.scene.background_colour())
    directions = pinhole.image_rays(index).directions
    places, _ = cameras.project(cameras.origins[index] + directions, index)
    width, height = cameras.size(index)
    grid = (places / places.new_tensor([width, height]) * 2 - 1).reshape(1, *pinhole.size(index)[::-1], 2)
    shown = torch.nn.functional.grid_sample(
        truth.permute(2, 0, 1)[None], grid, padding_mode="border", align_corners=False
    )
    return shown[0].permute(1, 2, 0), (grid[0].abs() < 1).all(-1)


def psnr(a: Any, b: Any, where: Any = slice(None)) -> float:
    """Returns the PSNR in decibels."""
    return float(-10 * np.log10(max(np.square(np.asarray(a) - np.asarray(b))[where].mean(), 1e-12)))


def compared(run: Run, driver: Any, pixels: int) -> dict[str, Any]:
    """Compares the page's pictures with rendered pictures and photographs."""
    cameras = run.scene.test.cameras
    pinhole = replace(cameras, distortion=None, models=None)
    pinhole = pinhole.downscaled(max(1, -(-max(cameras.width, cameras.height) // pixels)))
    between, of_page, of_render = [], [], []
    for view in np.linspace(0, len(cameras) - 1, VIEWS).round().astype(int).tolist():
        rendered = run.render(pinhole, view, heaviest=False).colour.clamp(0, 1)
        page = drawn(driver, pinhole, view)
        truth, there = photograph(run, view, pinhole)
        between.append(psnr(page, (rendered * 255).round() / 255))
        of_page.append(psnr(page, truth, there.numpy()))
        of_render.append(psnr((rendered * 255).round() / 255, truth, there.numpy()))
    return {
        "pixels": f"{pinhole.width} x {pinhole.height}",
        "psnr_between_worst": min(between),
        "psnr_between": float(np.mean(between)),
        "psnr_page": float(np.mean(of_page)),
        "psnr_render": float(np.mean(of_render)),
        "worst_difference_db": float(np.abs(np.subtract(of_page, of_render)).max()),
    }


def main(options: Options) -> None:
    """Measures and prints each run."""
    stored = read_json(options.json)["results"] if options.json is not None and options.json.is_file() else []
    results = {row["run"]: row for row in stored}
    with tempfile.TemporaryDirectory() as folder:
        for path in options.runs:
            run, page = Opening(data=options.data).open(path), Path(folder) / f"{path.name}.html"
            packed, size = export_web(run, page)
            with browser() as driver:
                seconds = first_picture(driver, page)
                driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", SMALL)
                row = {"run": path.name, "file_mb": size / 1e6, "cells": packed.scene["cells"]}
                row |= {"trained_seconds": run.config.budget, "first_picture_seconds": seconds}
                row |= compared(run, driver, options.pixels)
            results[path.name] = row
            print(json_text(row, indent=1), flush=True)
            write_results(options.json, list(results.values()), views=VIEWS)


if __name__ == "__main__":
    main(tyro.cli(Options))
