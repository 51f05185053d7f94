"""Chromium for tests of pages, where it is installed."""

import shutil

import pytest

_CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
_DRIVER = shutil.which("chromedriver")
_FLAGS = (
    "headless",
    "no-sandbox",
    "disable-quic",
    "no-first-run",
    "disable-background-networking",
    "disable-component-update",
    "disable-sync",
    "disable-dev-shm-usage",
    "enable-unsafe-swiftshader",  # WebGL without a GPU
    "force-device-scale-factor=0.5",  # a quarter of the pixels, which the processor draws
)

_SELDOM = """
const inTime = requestAnimationFrame.bind(window);
window.requestAnimationFrame = (draw) => setTimeout(() => inTime(draw), 90);
"""
"""Ten frames a second in place of sixty: without a GPU, what a page draws while a test looks at something else is most of the
processor's time."""


def start_chromium(profile, size, *flags):
    """A browser that keeps its console's messages; skips the test where selenium or Chromium is missing.

    Args:
        profile: an empty folder.
        size: "width,height" of the window, px.
        flags: more of Chromium's, without dashes.
    """
    webdriver = pytest.importorskip("selenium.webdriver")
    if not (_CHROMIUM and _DRIVER):
        pytest.skip("no chromium and chromedriver")
    options = webdriver.ChromeOptions()
    options.binary_location = _CHROMIUM
    for flag in (*_FLAGS, f"window-size={size}", f"user-data-dir={profile}", *flags):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(_DRIVER))
    driver.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": _SELDOM})
    return driver
