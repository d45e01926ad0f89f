"""The page of a calibration in a browser: Chromium without a window, driven by Selenium."""

import base64
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hexapod_example import Run

import legcal

pytestmark = pytest.mark.system

PATIENCE = 60  # [s] for plots in a browser that draws without a graphics card
INTERACTIVE = 2000  # [ms]
HOSTILE = "\"'`</script><img src=x onerror=alert(1)><script>alert(1)</script>"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Start Chromium; skip without it, and fail where it is there and cannot be driven."""
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    if chromium is None:
        pytest.skip("there is no Chromium (apt-get install chromium chromium-driver)")
    driver = shutil.which("chromedriver")
    if driver is None:
        pytest.fail("Chromium is there and chromedriver is not (apt-get install chromium-driver)")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for word in ("headless=new", "no-sandbox", "disable-gpu", "enable-unsafe-swiftshader",
                 "window-size=1280,900"):  # fmt: skip
        options.add_argument(f"--{word}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    with webdriver.Chrome(service=Service(driver), options=options) as found:
        found.set_script_timeout(PATIENCE)
        yield found


@pytest.fixture(scope="module")
def page(example_run: Run, browser: Any) -> Any:
    browser.get(legcal.write_report(example_run.calibration, example_run.output).as_uri())
    return browser


def _errors(browser: Any) -> list[str]:
    return [one["message"] for one in browser.get_log("browser") if one["level"] == "SEVERE"]


def _draw_all(browser: Any) -> None:
    """Bring every plot into sight and wait until it is drawn."""
    from selenium.webdriver.support.wait import WebDriverWait

    def is_drawn(_: Any) -> bool:
        return plot.get_dom_attribute("data-drawn") is not None

    for plot in browser.find_elements("css selector", ".plot"):
        browser.execute_script("arguments[0].scrollIntoView()", plot)
        WebDriverWait(browser, PATIENCE).until(is_drawn)


def test_everything_is_drawn_without_an_error(page: Any) -> None:
    _draw_all(page)
    assert _errors(page) == []
    assert len(page.find_elements("css selector", ".plot .gl-container canvas")) >= 2
    points = page.find_elements("css selector", "#residuals-leg .scatterlayer .point")
    assert len(points) > 500
    pictures = page.execute_script(
        "return [...document.querySelectorAll('.crop image')].map((i) => i.getBBox().width)"
    )
    assert len(pictures) == 40
    assert min(pictures) > 0


def test_sliders_move_the_machine(page: Any) -> None:
    _draw_all(page)

    def moved(name: str, value: int) -> Any:
        return page.execute_script(
            """const form = document.querySelector("form[data-for=machine-scene]");
            form.elements[arguments[0]].value = arguments[1];
            form.dispatchEvent(new Event("input", {bubbles: true}));
            return document.getElementById("machine-scene").data.slice(0, 2).map((t) => t.x);""",
            name,
            value,
        )

    nominal, calibrated = moved("factor", 0)
    assert calibrated == nominal
    nominal, calibrated = moved("factor", 1)
    apart = [abs(a - b) for a, b in zip(nominal, calibrated, strict=True) if a is not None]
    assert 1e-4 < max(apart) < 1e-2
    _, ten_times = moved("factor", 4)
    assert (
        max(
            abs(b - n - 10.0 * (a - n))
            for a, b, n in zip(calibrated, ten_times, nominal, strict=True)
            if n is not None
        )
        < 1e-9
    )
    assert moved("pose", 7)[0] != nominal
    assert moved("mode", 1)[1] != ten_times
    assert _errors(page) == []


def test_tables_sort_by_numbers_and_back(page: Any) -> None:
    button = page.find_element("xpath", "//*[@id='parameters']//th/button[text()='change']")

    def column() -> list[float]:
        cells = page.find_elements("css selector", "#parameters > .scroll tbody td:nth-child(4)")
        return [float(one.get_dom_attribute("data-value")) for one in cells]

    before = column()
    page.execute_script("arguments[0].click()", button)
    assert column() == sorted(before) != before
    page.execute_script("arguments[0].click()", button)
    assert column() == sorted(before, reverse=True)
    assert button.find_element("xpath", "..").get_dom_attribute("aria-sort") == "descending"


def test_an_outline_is_enlarged_and_zoomed(page: Any) -> None:
    button = page.find_element("css selector", ".crop .zoom")
    page.execute_script("arguments[0].click()", button)
    width = "return document.querySelector('#enlarged svg').viewBox.baseVal.width"
    before = page.execute_script(width)
    page.execute_script(
        """const stage = document.querySelector("#enlarged div");
        const box = stage.getBoundingClientRect();
        stage.dispatchEvent(new WheelEvent("wheel", {deltaY: -500, clientX: box.x + 9,
                                                     clientY: box.y + 9, cancelable: true}));"""
    )
    assert page.execute_script(width) < 0.5 * before
    page.execute_script("document.getElementById('enlarged').close()")


def test_it_prints_on_a4(page: Any) -> None:
    _draw_all(page)
    from selenium.webdriver.common.print_page_options import PrintOptions

    options = PrintOptions()
    options.set_page_size(PrintOptions.A4)
    pdf = base64.b64decode(page.print_page(options))
    sizes = {
        tuple(round(float(x)) for x in found.split())
        for found in re.findall(rb"/MediaBox\s*\[0 0 ([\d.]+ [\d.]+)\]", pdf)
    }
    assert sizes
    assert all(abs(w - 595) <= 1 and abs(h - 842) <= 1 for w, h in sizes)


def test_scenes_are_there_for_the_printer_and_no_longer_than_that(page: Any) -> None:
    _draw_all(page)
    copies = """dispatchEvent(new Event(arguments[0]));
        return [...document.querySelectorAll("#machine-scene canvas, #platform-space canvas")]
            .filter((one) => one.className === "copy").map((one) => new Set(
                one.getContext("2d").getImageData(0, 0, one.width, one.height).data).size);"""
    colours = page.execute_script(copies, "beforeprint")
    assert len(colours) == 2
    assert min(colours) > 50
    assert page.execute_script(copies, "afterprint") == []


def test_it_is_interactive_within_two_seconds(example_run: Run, browser: Any) -> None:
    path = legcal.write_report(example_run.calibration, example_run.output)
    times = []
    for _ in range(3):  # the best: others work on this machine too
        browser.get(path.as_uri())
        times.append(
            browser.execute_script(
                "return performance.getEntriesByType('navigation')[0].domContentLoadedEventEnd"
            )
        )
    assert min(times) <= INTERACTIVE


def test_hostile_names_do_nothing(example_run: Run, browser: Any, tmp_path: Path) -> None:
    calibration = example_run.calibration
    machine = calibration.dataset.machine
    legs = tuple(replace(leg, name=f"{leg.name}{HOSTILE}") for leg in machine.legs)
    measured = calibration.dataset.measurements
    views = tuple(replace(view, name=f"{HOSTILE}{view.name}") for view in measured.views)
    dataset = replace(
        calibration.dataset,
        machine=replace(machine, name=HOSTILE, legs=legs),
        measurements=replace(measured, views=views),
    )
    changed = replace(calibration, dataset=dataset, notes=(HOSTILE,))
    changed.__dict__["result"] = calibration.result
    browser.get(legcal.write_report(changed, tmp_path).as_uri())
    _draw_all(browser)
    assert _errors(browser) == []
    assert browser.execute_script("return document.querySelectorAll('img[src=x]').length") == 0
    assert HOSTILE in browser.find_element("css selector", "h1").text
