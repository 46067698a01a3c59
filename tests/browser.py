"""A headless browser without a GPU for tests, from Debian's packages chromium and chromium-driver."""

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
#: WebGPU on the CPU. Drawing to a canvas needs Vulkan.
WEBGPU = """--headless=new --enable-unsafe-webgpu --use-webgpu-adapter=swiftshader --enable-features=Vulkan
--use-vulkan=swiftshader --use-angle=swiftshader"""


@contextlib.contextmanager
def chromium(profile: Path, width: int = 1000, height: int = 700, *, flags: str = WEBGL):
    """Yields a selenium driver of a browser with its own profile folder; skips the test without a browser."""
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
    """Calls ``done`` until it returns a true value, and returns this value; fails after ``seconds``."""
    end = time.monotonic() + seconds
    while not (value := done()):
        assert time.monotonic() < end, f"timed out after {seconds} s"
        time.sleep(0.1)
    return value


def screenshot(driver) -> Image.Image:
    """Returns the visible page as an RGB image."""
    return Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB")
