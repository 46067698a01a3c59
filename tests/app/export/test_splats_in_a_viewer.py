"""Splats in a viewer of other people, in a browser. VORONERF_SPLAT_VIEWER names a folder where

    npm install three@0.187 @mkkellogg/gaussian-splats-3d@0.4.7

was run; nothing is fetched by the test.
"""

import functools
import http.server
import itertools
import math
import os
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from browser import chromium, screenshot, until
from test_export import run  # noqa: F401

from voronerf.app.export import export_splats
from voronerf.app.export.splats import picture
from voronerf.nerf.cameras import Cameras

SIZE = 240  # pixels along a side of the picture
FRAMES = 10  # that are drawn, since splats are sorted beside the drawing
MODULES = {
    "three": "three/build/three.module.js",
    "splats": "@mkkellogg/gaussian-splats-3d/build/gaussian-splats-3d.module.js",
}
PAGE = """<!doctype html><title>waiting</title><style>body {{ margin: 0; background: white }}</style>
<script type="importmap">{{"imports": {{"three": "/{three}", "splats": "/{splats}"}}}}</script>
<script type="module">
import * as THREE from "three";
import * as Splats from "splats";
const renderer = new THREE.WebGLRenderer({{antialias: false, preserveDrawingBuffer: true}});
renderer.setSize({size}, {size});
renderer.setClearColor(0xffffff, 1);
document.body.append(renderer.domElement);
const camera = new THREE.PerspectiveCamera({fov}, 1, 0.05, 100);
new THREE.Matrix4().set({pose}).decompose(camera.position, camera.quaternion, camera.scale);
camera.updateMatrixWorld();
const viewer = new Splats.Viewer({{
  renderer, camera, selfDrivenMode: false, useBuiltInControls: false, sharedMemoryForWorkers: false,
  gpuAcceleratedSort: false, integerBasedSort: false, sphericalHarmonicsDegree: 1,
  sceneRevealMode: Splats.SceneRevealMode.Instant,
}});
viewer.addSplatScene("/scene.ply", {{splatAlphaRemovalThreshold: 0, showLoadingUI: false}}).then(() => {{
  let frames = 0;
  const draw = () => {{
    viewer.update();
    viewer.render();
    if (++frames < {frames}) setTimeout(draw, 200);
    else document.title = "shown";
  }};
  draw();
}}).catch((error) => {{ document.title = "failed: " + error; }});
</script>"""


def page_of(camera):
    """The page that shows scene.ply from a camera whose pixels are square."""
    fov = math.degrees(2 * math.atan(camera.height / 2 / float(camera.intrinsics[0, 1])))
    pose = ", ".join(map(str, camera.poses[0].flatten().tolist()))
    return PAGE.format(**MODULES, frames=FRAMES, size=camera.width, fov=fov, pose=pose)


def in_a_viewer(packages, folder, size):
    """What the viewer shows of a folder's scene.ply and index.html, floats [h, w, 3] in 0..1."""

    class Handler(http.server.SimpleHTTPRequestHandler):
        def translate_path(self, path):
            root = folder if path in ("/index.html", "/scene.ply") else packages
            return str(root / path.lstrip("/"))

        def log_message(self, *_):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Handler))
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        with chromium(folder / "profile", size, size + 200) as driver:
            driver.get(f"http://127.0.0.1:{server.server_port}/index.html")
            until(lambda: driver.title != "waiting", 60)
            assert driver.title == "shown", (driver.title, driver.get_log("browser"))
            return np.array(screenshot(driver).crop((0, 0, size, size)), dtype=np.float32) / 255
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_viewer_shows_what_the_run_shows(run, tmp_path):  # noqa: F811
    packages = Path(os.environ.get("VORONERF_SPLAT_VIEWER", "none")) / "node_modules"
    if not all((packages / module).is_file() for module in MODULES.values()):
        pytest.skip("VORONERF_SPLAT_VIEWER names no folder with a viewer of splats")
    clock = itertools.count().__next__
    splats, _ = export_splats(run, tmp_path / "scene.ply", count=400, seconds=300, clock=clock)
    small = run.scene.test.cameras[[0]]
    camera = Cameras(small.poses, small.intrinsics * (SIZE / small.width), SIZE, SIZE)
    (tmp_path / "index.html").write_text(page_of(camera))
    seen = torch.from_numpy(in_a_viewer(packages, tmp_path, SIZE))
    assert seen.std() > 0.1
    likeness = -10 * (seen - picture(splats, camera, torch.ones(3)).clamp(0, 1)).square().mean().log10()
    assert likeness > 30, float(likeness)
