"""Chromium without a window, driven by Selenium."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

PATIENCE = 60  # [s] for what is drawn without a graphics card


@contextmanager
def chromium() -> Iterator[Any]:
    """Start Chromium; skip without it, and fail where it is there and cannot be driven."""
    found = shutil.which("chromium") or shutil.which("chromium-browser")
    if found is None:
        pytest.skip("there is no Chromium (apt-get install chromium chromium-driver)")
    driver = shutil.which("chromedriver")
    if driver is None:
        pytest.fail("Chromium is there and chromedriver is not (apt-get install chromium-driver)")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = found
    for word in ("headless=new", "no-sandbox", "disable-gpu", "enable-unsafe-swiftshader",
                 "window-size=1280,900"):  # fmt: skip
        options.add_argument(f"--{word}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with webdriver.Chrome(service=Service(driver), options=options) as browser:
        browser.set_script_timeout(PATIENCE)
        yield browser


def errors(browser: Any) -> list[str]:
    """Return what the console calls an error."""
    return [one["message"] for one in browser.get_log("browser") if one["level"] == "SEVERE"]


def until(condition: Callable[[], Any]) -> Any:
    """Wait for something that is true, and return it."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found
