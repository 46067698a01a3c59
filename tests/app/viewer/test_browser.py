"""Tests of the viewer in a real browser."""

from __future__ import annotations

import re
import threading

import numpy as np
import pytest
from browser import chromium, screenshot, until
from PIL import Image

from voronerf.app.viewer.pictures import cell_at

pytestmark = pytest.mark.slow
pytest.importorskip("viser", reason="viser is not installed")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")


@pytest.fixture
def browser(tmp_path):
    with chromium(tmp_path / "profile") as driver:
        yield driver


@pytest.fixture
def served(viewer):
    """The viewer, served by a thread."""
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
    middle = (slice(height // 3, height), slice(width // 3, 3 * width // 5))  # no control covers this part

    def seen():
        page = screenshot(browser)
        left, top = canvas.location["x"], canvas.location["y"]
        return np.array(page.crop((left, top, left + width, top + height)), dtype=float)[middle]

    def far(picture):
        """Returns whether the canvas differs from a picture by more than 4 levels on average."""
        return np.abs(seen() - picture).mean() > 4

    image = (run.render(client.camera(128)).colour.clamp(0, 1) * 255).round().byte()
    whole = Image.fromarray(image.numpy()).resize((width, height), Image.Resampling.BILINEAR)
    colour = np.array(whole, dtype=float)[middle]
    assert colour.std() > 20
    until(lambda: not far(colour))

    link = browser.find_element("link text", "Draw it in this browser")
    assert link.get_attribute("href") == f"{served.address}/scene.html"
    browser.find_element("css selector", "input[value='colour']").click()
    until(lambda: browser.find_elements("xpath", "//*[@role='option'][.='cells']"))[0].click()
    until(lambda: client.look.pane == "cells" and far(colour))

    webdriver.ActionChains(browser).move_to_element(canvas).click().perform()
    body = browser.find_element("tag name", "body")
    until(lambda: f"of {run.diagram.num_cells}" in body.text)
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def wide(camera, view):
    """Returns the camera if it sees the whole width of `view`, else None (the page's size is not known yet)."""
    sees = camera.width / camera.intrinsics[0, 0]
    return camera if sees >= 0.99 * view.width / view.intrinsics[0, 0] else None


def test_a_phone_folds_the_panel_below_all_of_the_scene(run, served, browser) -> None:
    metrics = {"width": 390, "height": 844, "deviceScaleFactor": 3, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)
    browser.get(served.address)
    client = until(lambda: next(iter(served.clients.values()), None))
    body = browser.find_element("tag name", "body")

    def seen(part):
        """Returns an element's [left, top, right, bottom], or None if it is covered or partly outside the window."""
        at = browser.execute_script(
            "const r = arguments[0].getBoundingClientRect(), x = r.x + r.width / 2, y = r.y + r.height / 2;"
            "const top = document.elementFromPoint(x, y), over = top && !arguments[0].contains(top);"
            "return over ? null : [r.left, r.top, r.right, r.bottom]",
            part,
        )
        return at if at and at[0] >= 0 and at[1] > 844 / 3 and at[2] <= 390 and at[3] <= 844 else None

    show = until(lambda: browser.find_elements("css selector", "input[value='colour']"))[0]
    title = browser.find_element("xpath", f"//*[text()='{served.subject.name}']")
    assert until(lambda: seen(title))[1] > 844 - 110 and not seen(show)
    view = run.scene.test.cameras
    camera = until(lambda: wide(client.camera(128), view))
    webdriver.ActionChains(browser).move_by_offset(195, 422).click().perform()
    browser.find_element("xpath", "//*[text()='Settings']").click()
    until(lambda: seen(show))
    until(lambda: re.search(r"\d+ x 128 pixels in \d+\.\d\d s", body.text))
    assert "Drag: turn." in body.text and f"of {run.diagram.num_cells}" in body.text
    assert client.look.picked == cell_at(served.subject, camera, client.look, 0.5, 0.5)
    show.click()
    until(lambda: browser.find_elements("xpath", "//*[@role='option'][.='cells']"))[0].click()
    until(lambda: client.look.pane == "cells")
