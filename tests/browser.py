"""A real browser for tests: Debian's packages chromium and chromium-driver, without a screen and without a GPU."""

import contextlib
import io
import shutil
import time
from pathlib import Path

import pytest
from PIL import Image

FLAGS = """--no-sandbox --disable-quic --no-first-run --disable-background-networking --disable-component-update
--disable-sync --hide-scrollbars --force-device-scale-factor=1"""
WEBGL = "--headless --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader"
#: On the CPU; without Vulkan, a canvas cannot be drawn to.
WEBGPU = """--headless=new --enable-unsafe-webgpu --use-webgpu-adapter=swiftshader --enable-features=Vulkan
--use-vulkan=swiftshader --use-angle=swiftshader"""


@contextlib.contextmanager
def chromium(profile: Path, width: int = 1000, height: int = 700, *, flags: str = WEBGL):
    """A driver of a browser whose profile is in a folder of its own; skips the test where there is none."""
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    paths = [shutil.which(name) for name in ("chromium", "chromedriver")]
    if None in paths:
        pytest.skip("there is no chromium with its chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = paths[0]
    for flag in (*FLAGS.split(), *flags.split(), f"--window-size={width},{height}", f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(paths[1]))
    try:
        yield driver
    finally:
        driver.quit()


def until(done, seconds=30.0):
    """What a function gives when it gives something true; fails where it does not within so many seconds."""
    end = time.monotonic() + seconds
    while not (found := done()):
        assert time.monotonic() < end, f"waited {seconds} s in vain"
        time.sleep(0.1)
    return found


def screenshot(driver) -> Image.Image:
    """What the page shows, in RGB."""
    return Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
