"""The viewer in a real browser: Debian's packages chromium and chromium-driver, without a screen and without a GPU."""

from __future__ import annotations

import io
import shutil
import threading
import time

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("viser", reason="viser is not installed")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")

FLAGS = """--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking
--disable-component-update --disable-sync --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader
--hide-scrollbars --force-device-scale-factor=1 --window-size=1000,700"""


@pytest.fixture
def browser(tmp_path):
    paths = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in paths:
        pytest.skip("there is no chromium with its chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = paths[0]
    for flag in (*FLAGS.split(), f"--user-data-dir={tmp_path / 'profile'}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(paths[1]))
    yield driver
    driver.quit()


@pytest.fixture
def served(viewer):
    """The viewer, with a thread that renders for it."""
    stop = threading.Event()
    thread = threading.Thread(target=viewer.serve, args=(stop.is_set,))
    thread.start()
    yield viewer
    stop.set()
    viewer.wake.set()
    thread.join()


def until(done, seconds=30.0):
    end = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < end, f"waited {seconds} s in vain"
        time.sleep(0.1)
    return found


def test_chromium_shows_the_scene_and_its_cells(run, served, browser) -> None:
    browser.get(served.address)
    client = until(lambda: next(iter(served.clients.values()), None))
    canvas = until(lambda: browser.find_elements("tag name", "canvas"))[0]
    height, width = canvas.size["height"], canvas.size["width"]
    middle = (slice(height // 3, height), slice(width // 3, 3 * width // 5))  # nothing lies over it

    def seen():
        page = Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB")
        left, top = canvas.location["x"], canvas.location["y"]
        return np.array(page.crop((left, top, left + width, top + height)), dtype=float)[middle]

    def far(picture):
        """Whether the canvas is not yet like a picture, in the mean over channels and pixels."""
        return np.abs(seen() - picture).mean() > 4

    image = (run.render(client.camera(128)).colour.clamp(0, 1) * 255).round().byte()
    whole = Image.fromarray(image.numpy()).resize((width, height), Image.Resampling.BILINEAR)
    colour = np.array(whole, dtype=float)[middle]
    assert colour.std() > 20
    until(lambda: not far(colour))

    browser.find_element("css selector", "input[value='colour']").click()
    until(lambda: browser.find_elements("xpath", "//*[@role='option'][.='cells']"))[0].click()
    until(lambda: client.look.pane == "cells" and far(colour))

    browser.find_element("xpath", "//*[text()='Cells']").click()
    webdriver.ActionChains(browser).move_to_element(canvas).click().perform()
    body = browser.find_element("tag name", "body")
    until(lambda: f"of {run.diagram.num_cells}" in body.text)
    assert "samples of the last split" in body.text
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
