"""Tests that pages draw the pictures of `Run.render`, in a real browser whose WebGPU runs on the CPU."""

from __future__ import annotations

import base64
import contextlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from browser import WEBGPU, chromium, screenshot, until
from helpers import trained
from test_packing import HOSTILE

from voronerf.app import open_run
from voronerf.app.scenes import builtin_scene
from voronerf.app.train.config import TrainConfig
from voronerf.app.web import export_web

pytestmark = pytest.mark.slow
pytest.importorskip("selenium.webdriver", reason="selenium is not installed")

#: The window size in pixels; it is small since the CPU draws.
WINDOW = 32, 32
PICTURE = """
const [camera, done] = arguments;
voronerf.started.then(() => voronerf.picture(camera)).then(
  (bytes) => done(btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""))),
  (error) => done(`error: ${error}`));
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    with chromium(tmp_path_factory.mktemp("profile"), 420, 480, flags=WEBGPU) as driver:
        driver.set_script_timeout(120)
        driver.get("chrome://version")
        if not driver.execute_script("return navigator.gpu ? navigator.gpu.requestAdapter().then(Boolean) : false"):
            pytest.skip("this chromium has no WebGPU on the CPU")
        resize(driver, *WINDOW)
        yield driver


def resize(browser, width, height, **phone):
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False, **phone}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


@contextlib.contextmanager
def resized(browser, width, height, **phone):
    """Resizes the window, and restores its size at the end of the context."""
    resize(browser, width, height, **phone)
    try:
        yield
    finally:
        resize(browser, *WINDOW)


@pytest.fixture(scope="module")
def page(browser, runs, tmp_path_factory):
    """A function that opens the page of a run and returns the browser."""
    folder, written = tmp_path_factory.mktemp("pages"), {}

    def opened(run, fragment=""):
        if id(run) not in written:
            written[id(run)] = folder / f"{len(written)}.html", run
            export_web(run, written[id(run)][0])
        browser.get("about:blank")
        browser.get(f"{written[id(run)][0].as_uri()}{fragment}")
        return browser

    return opened


def picture(browser, cameras, index):
    """Returns the page's picture from a camera, uint8 [h, w, 3]."""
    width, height = cameras.size(index)
    fx, fy, cx, cy = cameras.intrinsics[index].tolist()
    pose = cameras.poses[index, :3].flatten().tolist()
    camera = {"pose": pose, "focal": [fx, fy], "centre": [cx, cy], "width": width, "height": height}
    encoded = browser.execute_async_script(PICTURE, camera)
    assert not encoded.startswith("error"), encoded
    return np.frombuffer(base64.b64decode(encoded), np.uint8).reshape(height, width, 4)[..., :3]


def rendered(run, cameras, index):
    return (run.render(cameras, index).colour.clamp(0, 1) * 255).round().byte().numpy()


def psnr(a, b):
    return -10 * np.log10(max(np.square(a.astype(float) - b).mean() / 255**2, 1e-10))


def quiet(browser):
    """Returns whether the page has logged no error."""
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []


def still(browser):
    """Waits for the sharp picture; returns the page's URL fragment."""
    until(lambda: " x " in browser.find_element("id", "speed").text, 60)
    return browser.execute_script("return location.hash")


def test_a_trained_run_looks_as_it_is_rendered(page, tmp_path):
    scene = builtin_scene(24, train_views=16, test_views=5)
    config = TrainConfig(out=tmp_path, steps=300, cells=(4, 2), split_at=(100, 200), rays=512, samples=(32,))
    trained(config, scene)
    run = open_run(tmp_path, scene=scene)
    browser = page(run)
    for index in (0, 3):
        wanted = rendered(run, scene.test.cameras, index)
        assert wanted.std() > 20
        assert psnr(picture(browser, scene.test.cameras, index), wanted) >= 45
    assert quiet(browser)


@pytest.mark.parametrize("kind", ["nerf", "traced"])
def test_a_field_is_drawn(page, runs, kind):
    """A page draws the rendered picture of any lens (test_shader.py tests the shaders of all kinds as C++)."""
    run = runs(kind)
    browser, lens = page(run), torch.tensor([[37.0, 52.0, 11.0, 30.0]])
    cameras = replace(run.scene.test.cameras[3:4], intrinsics=lens, width=29, height=43)
    wanted = rendered(run, cameras, 0)
    assert wanted.std() > 5
    assert psnr(picture(browser, cameras, 0), wanted) >= 45
    assert quiet(browser)


@pytest.fixture
def tall(browser):
    """A window so high that the page's header does not cover the middle of the window."""
    with resized(browser, 64, 112):
        yield


def test_a_click_hides_a_cell_and_another_shows_it(tall, page, runs):
    run = runs("hash grid")
    browser = page(run)
    still(browser)
    before = np.array(screenshot(browser))
    canvas = browser.find_element("id", "canvas")
    middle = "return renderer.pick(renderer.fine, renderer.fine.width >> 1, renderer.fine.height >> 1)"
    cell = browser.execute_script(middle)["cell"]
    assert 0 <= cell < run.diagram.num_cells
    canvas.click()
    picked = browser.find_element("id", "picked")  # in the folded panel
    until(lambda: f"Cell {cell} of {run.diagram.num_cells}." in picked.get_attribute("textContent"))
    canvas.send_keys("c")
    assert browser.find_element("id", "cells").get_attribute("aria-pressed") == "true"
    canvas.click()
    until(lambda: browser.execute_script("return state.hidden.has(arguments[0])", cell))
    assert f"hide={cell}" in still_after(browser)
    assert browser.execute_script(middle)["cell"] != cell
    browser.execute_script("document.querySelector('#hidden button').click()")
    canvas.send_keys("c")
    until(lambda: "hide" not in still(browser))
    until(lambda: np.array_equal(np.array(screenshot(browser))[60:], before[60:]))
    assert quiet(browser)


def still_after(browser):
    """Waits for the sharp picture after a change; returns the page's URL fragment."""
    until(lambda: browser.execute_script("return drawn === version"), 60)
    return still(browser)


def test_a_view_is_in_the_address(page, runs):
    run = runs("hash grid")
    browser = page(run)
    first = still(browser)
    browser.find_element("id", "canvas").send_keys("\ue014+")  # the right arrow key, then zoom in
    browser.execute_script("element('axis').value = 2; element('axis').dispatchEvent(new Event('change'))")
    moved = still_after(browser)
    assert moved != first and "cut=2,0.5" in moved
    shown = seen(browser)
    page(run, moved)
    assert still(browser) == moved
    assert np.abs(seen(browser) - shown).max() <= 4  # the fragment keeps six digits
    page(run, "#v=1,2,NaN,0,0,0,1,1,1&hide=-1,1e9,x&cut=9,9&back=%3Cb%3E&cells=2")
    assert still(browser) == first and quiet(browser)


def seen(browser):
    """Returns the picture of the page's own camera, RGBA [20 * 30 * 4]."""
    camera = browser.execute_script("return {...cameraOf(state.view, 30, 20), width: 30, height: 20}")
    return np.frombuffer(base64.b64decode(browser.execute_async_script(PICTURE, camera)), np.uint8).astype(int)


def test_a_cut_shows_what_is_behind_it_alone(page, runs):
    run = runs("hash grid")
    browser = page(run)
    whole = seen(browser)
    browser.execute_script("Object.assign(state, {axis: 2, cut: 0})")
    assert set(seen(browser)) == {255}  # all white
    browser.execute_script("Object.assign(state, {axis: 2, cut: 1})")
    assert np.array_equal(seen(browser), whole)
    browser.execute_script("Object.assign(state, {axis: 2, cut: 0.5})")
    assert not np.array_equal(seen(browser), whole)


def test_the_path_goes_along_the_training_cameras(page, runs):
    run = runs("hash grid")
    browser = page(run)
    still(browser)
    browser.execute_script("goTo(3)")
    camera = browser.execute_script("return {pose: cameraOf(state.view, 40, 40).pose, first: scene.cameras[3]}")
    assert np.allclose(camera["pose"], camera["first"][:12], atol=1e-5)
    browser.find_element("id", "canvas").send_keys("p")
    until(lambda: browser.execute_script("return state.path") > 3)
    browser.find_element("id", "canvas").send_keys("p")
    until(lambda: browser.execute_script("return !state.playing"))


def test_a_name_is_not_executed_and_nothing_is_loaded(page, runs):
    run = runs("hash grid")
    hostile = replace(run, scene=replace(run.scene, name=HOSTILE))
    browser = page(hostile)
    still(browser)
    assert browser.find_element("id", "name").get_attribute("textContent") == HOSTILE
    assert browser.execute_script("return document.querySelectorAll('img, script').length") == 5
    loaded = "return performance.getEntriesByType('resource').map((entry) => entry.name.slice(0, 5))"
    assert set(browser.execute_script(loaded)) <= {"data:"}
    blocked = "const s = document.createElement('script'); s.text = 'window.run = 1'; document.body.append(s);"
    assert browser.execute_script(f"{blocked} return window.run") is None


@pytest.mark.parametrize("ratio", [1, 3])
def test_a_phone_has_the_panel_within_the_window(browser, page, runs, ratio):
    with resized(browser, 390, 844, deviceScaleFactor=ratio, mobile=True):
        page(runs("hash grid"))
        until(lambda: browser.find_element("id", "still").get_attribute("hidden"), 60)
        size = browser.execute_script("return [canvas.width, canvas.height]")
        assert size == [390 * ratio, 844 * ratio]
        assert not browser.find_element("id", "panel").is_displayed()
        browser.find_element("id", "fold").click()
        for part in browser.find_elements("css selector", "#panel :is(button, select, input, label)"):
            at = browser.execute_script(
                "const r = arguments[0].getBoundingClientRect(); return [r.left, r.right]", part
            )
            assert 0 <= at[0] <= at[1] <= 390
        assert browser.execute_script("return document.documentElement.scrollWidth") == 390


def test_without_webgpu_the_page_says_so_and_turns_a_picture(browser, page, runs):
    gone = {"source": "Object.defineProperty(Navigator.prototype, 'gpu', {value: undefined})"}
    script = browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", gone)
    try:
        with resized(browser, 160, 160):  # leaves space beneath the text
            page(runs("hash grid"))
            until(lambda: "This browser has no WebGPU." in browser.find_element("id", "note").text)
            still_picture = browser.find_element("css selector", "#still img")
            assert still_picture.is_displayed() and still_picture.get_property("naturalWidth") == 40
    finally:
        browser.execute_cdp_cmd("Page.removeScriptToEvaluateOnNewDocument", script)


def test_a_lost_device_is_replaced_twice_within_a_minute(page, runs):
    browser = page(runs("hash grid"))
    still(browser)
    browser.execute_script("hide(3, true)")
    fragment, shown = still_after(browser), seen(browser)
    lose = "window.lost = renderer; renderer.device.destroy()"
    for _ in range(2):
        browser.execute_script(lose)
        until(lambda: browser.execute_script("return renderer !== lost && drawn === version"), 60)
        assert still(browser) == fragment and np.array_equal(seen(browser), shown)
    browser.execute_script(lose)
    note = "return element('still').hidden ? '' : text('note')"
    until(lambda: "took the GPU away 3 times in a minute" in browser.execute_script(note))
