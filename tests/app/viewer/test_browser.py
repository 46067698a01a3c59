"""The viewer in a real browser."""

from __future__ import annotations

import threading

import numpy as np
import pytest
from browser import chromium, screenshot, until
from PIL import Image

pytest.importorskip("viser", reason="viser is not installed")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")


@pytest.fixture
def browser(tmp_path):
    with chromium(tmp_path / "profile") as driver:
        yield driver


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


def test_chromium_shows_the_scene_and_its_cells(run, served, browser) -> None:
    browser.get(served.address)
    client = until(lambda: next(iter(served.clients.values()), None))
    canvas = until(lambda: browser.find_elements("tag name", "canvas"))[0]
    height, width = canvas.size["height"], canvas.size["width"]
    middle = (slice(height // 3, height), slice(width // 3, 3 * width // 5))  # nothing lies over it

    def seen():
        page = screenshot(browser)
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
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
