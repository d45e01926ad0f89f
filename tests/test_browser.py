"""Pages and the viewer in a browser: Chromium without a window, driven by Selenium."""

import csv
import io
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clicked_joints import seen_from
from hexapod_example import HEXAPOD, Run
from scipy.spatial.transform import RigidTransform
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

import legcal
from legcal.calibration.detection import Detection, Examination
from legcal.data.reasons import Reason, Rejection
from legcal.exports.subject import Subject
from legcal.geometry.motions import pose_distance
from legcal.viewer.click_server import ClickServer
from legcal.viewer.server import Address
from legcal.viewer.source import open_source
from legcal.viewer.view_server import ViewServer

pytestmark = pytest.mark.system

PATIENCE = 60  # [s] for what is drawn without a graphics card


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
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
    with webdriver.Chrome(service=Service(driver), options=options) as started:
        started.set_script_timeout(PATIENCE)
        yield started


def _errors(browser: Any) -> list[str]:
    """Return what the console calls an error."""
    return [one["message"] for one in browser.get_log("browser") if one["level"] == "SEVERE"]


def until(condition: Callable[[], Any]) -> Any:
    """Wait for something that is true, and return it."""
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.02)
    return found


# Pages of calibrations


@pytest.fixture(scope="module")
def page(example_run: Run, browser: Any) -> Any:
    browser.get(legcal.write_report(example_run.calibration, example_run.output).as_uri())
    return browser


def _moved(browser: Any, name: str, value: int) -> dict[str, Any]:
    """Set a control of the machine's scene; return its lines by the names of the legend."""
    layers = browser.execute_script(
        """const form = document.querySelector("form[data-for=machine-scene]");
        form.elements[arguments[0]].value = arguments[1];
        form.elements[arguments[0]].dispatchEvent(new Event("input", {bubbles: true}));
        return document.getElementById("machine-scene").layers;""",
        name,
        value,
    )
    return {layer["name"]: np.array(layer["lines"]) for layer in layers if "name" in layer
            and layer["name"] != "cameras"}  # fmt: skip


def test_everything_is_drawn_without_an_error(page: Any) -> None:
    colours = page.execute_script(
        """const canvas = document.getElementById("machine-scene");
        const { width, height } = canvas;
        const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
        return new Set(new Uint32Array(data.buffer)).size;"""
    )
    assert colours > 20  # more than that of the paper
    points = page.execute_script(
        "return [...document.querySelectorAll('.charts [data-points]')].map("
        "(path) => path.getBBox().width)"
    )
    assert len(points) == 3 * 6  # of each leg
    assert min(points) > 10.0
    pictures = page.execute_script(
        "return [...document.querySelectorAll('.crop image')].map((i) => i.getBBox().width)"
    )
    assert len(pictures) == 40
    assert min(pictures) > 0
    assert _errors(page) == []


def test_sliders_move_the_machine(page: Any) -> None:
    first = _moved(page, "pose", 0)
    apart = np.abs(first["calibrated"] - first["nominal"]).max()
    assert 0.01 < apart < 0.1  # m: a millimetre is seen without the slider
    still = _moved(page, "factor", 0)
    np.testing.assert_allclose(still["calibrated"], still["nominal"], atol=1e-15)
    nominal, once = (_moved(page, "factor", 1)[name] for name in ("nominal", "calibrated"))
    assert 1e-4 < np.abs(once - nominal).max() < 1e-2
    ten = _moved(page, "factor", 4)
    np.testing.assert_allclose(ten["calibrated"] - nominal, 10.0 * (once - nominal), atol=1e-9)
    rings = next(name for name in ten if "1 sigma" in name)

    def sizes(lines: Any) -> Any:
        return np.ptp(lines, axis=1).max(axis=1)

    assert sizes(ten[rings]).max() > 0.0
    np.testing.assert_allclose(sizes(ten[rings]), sizes(still[rings]), atol=1e-12)  # as said
    assert np.abs(_moved(page, "pose", 7)["nominal"] - nominal).max() > 1e-3
    assert _errors(page) == []


# Correcting outlines on the page of ``legcal detect``.

SIGMA = 0.37  # [px] of what is placed by hand in these tests
END_SCALE = 12.0  # pixels of the screen for one of the image, where an end is enlarged


@pytest.fixture(scope="module")
def examined(
    example_run: Run, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Examination]:
    """The outlines of the example as given ones, some images of each view, and their pages."""
    folder = tmp_path_factory.mktemp("corrected") / "hexapod"
    shutil.copytree(HEXAPOD, folder)
    shutil.copy(example_run.output / "observations.csv", folder)
    return folder, legcal.doctor(folder, output=folder.parent / "found")


@pytest.fixture(scope="module")
def detection(examined: tuple[Path, Examination]) -> tuple[Path, Detection]:
    folder, found = examined
    assert found.detection is not None
    return folder, found.detection


class Dialog:
    """A dialog of a page."""

    def __init__(self, browser: Any, name: str) -> None:
        self.browser, self.name = browser, name

    def find(self, selector: str) -> Any:
        return self.browser.find_element("css selector", f"#{self.name} {selector}")

    def row(self, condition: str) -> Any:
        """Return the row of the list that meets a condition of XPath."""
        return self.browser.find_element("xpath", f"//*[@id='{self.name}']//li/button[{condition}]")

    def until(self, script: str) -> Any:
        """Wait for what a script returns."""
        return until(lambda: self.browser.execute_script(script))

    def download(self, button: str, path: Path) -> str:
        """Return the text of the file behind a button."""
        path.unlink(missing_ok=True)
        self.find(button).click()
        until(path.exists)
        return path.read_text("utf-8")


def _download_to(browser: Any, folder: Path) -> None:
    browser.execute_cdp_cmd(
        "Browser.setDownloadBehavior", {"behavior": "allow", "downloadPath": str(folder)}
    )


class Editor(Dialog):
    """The editor of a page, used as people do."""

    def __init__(self, browser: Any, page: Path) -> None:
        super().__init__(browser, "editor")
        browser.get(page.as_uri())

    def open(self, image: int) -> None:
        """Open the editor at an image."""
        button = self.browser.find_element("css selector", f"figcaption [data-edit='{image}']")
        self.browser.execute_script("arguments[0].click()", button)
        self.until("return document.querySelector('#editor .rows button') !== null")
        self.until(
            "return [...document.querySelectorAll('#editor image')].every((i) => i.getBBox().width)"
        )
        self.find("[name=sigma]").clear()
        self.find("[name=sigma]").send_keys(str(SIGMA))

    def close(self) -> None:
        self.find("[name=close]").click()

    def choose(self, name: str) -> None:
        self.row(f"b[text()='{name}']").click()

    def press(self, *keys: str) -> None:
        """Press keys; one of several words, as "Shift ArrowDown", holds the first."""
        named = {"Ctrl": Keys.CONTROL, "Shift": Keys.SHIFT, "Esc": Keys.ESCAPE,
                 "Left": Keys.ARROW_LEFT, "Down": Keys.ARROW_DOWN}  # fmt: skip
        actions = ActionChains(self.browser)
        for words in keys:
            *held, key = (named.get(word, word) for word in words.split())
            for one in held:
                actions.key_down(one)
            actions.send_keys(key)
            for one in held:
                actions.key_up(one)
        actions.perform()

    def drag(self, end: int, dx: float, dy: float, *, to_the_end: bool = True) -> None:
        """Drag an end by pixels of the image, enlarged."""
        self.press(str(end))
        handle = self.find(f".handle[data-end='{end - 1}'] circle")
        held = ActionChains(self.browser).click_and_hold(handle)
        held = held.move_by_offset(round(END_SCALE * dx), round(END_SCALE * dy))
        (held.release() if to_the_end else held).perform()

    def release(self) -> None:
        ActionChains(self.browser).release().perform()

    def state(self, name: str) -> str:
        return str(self.row(f"b[text()='{name}']").find_element("css selector", "span").text)


def _rows(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def _ends(row: dict[str, str]) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.array([float(row[name]) for name in ("u0", "v0", "u1", "v1")])


def test_outlines_are_corrected_on_the_page_and_calibrate_takes_them(
    detection: tuple[Path, Detection], browser: Any, tmp_path: Path
) -> None:
    folder, found = detection
    out = folder.parent / "found"
    _download_to(browser, tmp_path)
    editor = Editor(browser, out / "index.html")
    before = _rows((out / "observations.csv").read_text())
    moved, dropped = 4, 1  # rows of the first image
    editor.open(0)
    names = [
        row.text.splitlines()[0] for row in browser.find_elements("css selector", ".rows button")
    ]
    editor.choose(names[moved])
    editor.drag(1, 2.0, 1.0)
    assert editor.state(names[moved]) == "used (edited)"
    editor.drag(2, -3.0, 0.0)
    editor.press("Ctrl z")  # the second end is where it was
    editor.drag(2, 9.0, 9.0, to_the_end=False)
    editor.press("Esc")  # nothing has moved, and the editor stays
    assert "stays as it was" in editor.find("[role=status]").text
    editor.release()
    editor.choose(names[dropped])
    editor.press("r")
    assert editor.state(names[dropped]) == "rejected by hand (edited)"
    editor.choose(names[0])
    editor.press("r")
    assert editor.state(names[0]).startswith("rejected")
    editor.find("[name=undo]").click()
    assert editor.state(names[0]) == "used"
    text = editor.download("[data-download]", tmp_path / "observations.csv")
    editor.close()
    assert "2 outlines are edited" in browser.find_element("id", "edit-state").text
    after = _rows(text)
    changed = [i for i, (a, b) in enumerate(zip(before, after, strict=True)) if a != b]
    assert changed == [dropped, moved]
    # What is still true of a rejected outline stays; of a moved one nothing that was measured does.
    verdict = {"verdict": "rejected", "reason": "by_hand", "source": "edited"}
    assert after[dropped] == before[dropped] | verdict
    assert _ends(after[moved]) - _ends(before[moved]) == pytest.approx(
        [2.0, 1.0, 0.0, 0.0], abs=0.1
    )
    of_image = dict.fromkeys(("contrast", "length", "residual", "gamma", "by_gamma"), "")
    numbers = ("a", "b", "c", "u0", "v0", "u1", "v1")
    variance = {"s00": str(SIGMA**2), "s01": "0", "s11": str(SIGMA**2)}
    expected = before[moved] | of_image | variance | {"source": "edited"}
    assert after[moved] == expected | {name: after[moved][name] for name in numbers}

    corrected = tmp_path / "hexapod"
    shutil.copytree(folder, corrected)
    (corrected / "observations.csv").write_text(text)
    calibration = legcal.calibrate(corrected)
    used = calibration.solution.outlines
    assert [i for i, source in enumerate(used.source) if source == "edited"] == changed
    assert (used.used[dropped], used.reason[dropped]) == (False, Rejection(Reason.BY_HAND))
    k = calibration.residuals.index.tolist().index(moved)
    line = np.array([float(after[moved][name]) for name in "abc"])
    camera = calibration.dataset.measurements.views[0].camera
    off = camera.line_offset(found.outlines.h[moved], camera.undistort(used.ends[moved]))
    assert used.h[moved] == pytest.approx(line, abs=1e-12)
    assert 1.0 < abs(off[0]) < 2.5  # across the line
    assert np.abs(calibration.residuals.offset[k]) == pytest.approx(np.abs(off), abs=0.3)
    assert _errors(browser) == []


# Clicking joints on the page of ``legcal detect``.


class Placer(Dialog):
    """The editor of clicks on joints, used as people do."""

    def __init__(self, browser: Any) -> None:
        super().__init__(browser, "placer")

    def open(self, image: int) -> None:
        button = self.browser.find_element("css selector", "[data-place]")
        self.browser.execute_script("arguments[0].click()", button)
        while self.shown() != image:
            self.find("[name=next]").click()
        self.until("return document.querySelector('#placer image').getBBox().width > 0")

    def shown(self) -> int:
        return int(self.find("[name=image]").get_property("value"))

    def on_screen(self, px: Any) -> tuple[int, int]:
        x, y = self.browser.execute_script(
            "const matrix = document.querySelector('#placer .stage svg').getScreenCTM();"
            "const { x, y } = new DOMPoint(...arguments[0]).matrixTransform(matrix);"
            "return [x, y];",
            [float(x) for x in px],
        )
        return round(x), round(y)

    def click(self, px: Any) -> None:
        actions = ActionChains(self.browser)
        pointer: Any = actions.w3c_actions.pointer_action
        pointer.move_to_location(*self.on_screen(px)).click()
        actions.perform()

    def drag(self, start: Any, end: Any) -> None:
        actions = ActionChains(self.browser)
        pointer: Any = actions.w3c_actions.pointer_action
        pointer.move_to_location(*self.on_screen(start)).pointer_down()
        pointer.move_to_location(*self.on_screen(end)).pointer_up()
        actions.perform()

    def choose(self, joint: str) -> None:
        self.row(f"starts-with(b, '{joint} ')").click()

    def press_delete(self, joint: str) -> None:
        self.choose(joint)
        self.find("[name=remove]").click()

    @property
    def scale(self) -> float:
        """Pixels of the screen for one of the image."""
        script = "return document.querySelector('#placer .stage svg').getScreenCTM().a"
        return float(self.browser.execute_script(script))


def placing(
    browser: Any, page: str, folder: Path, found: Detection
) -> tuple[Placer, RigidTransform, dict[str, Any]]:
    """Open the first image of a page; return its editor, camera, and where joints are seen."""
    browser.get(page)
    placer, camera = Placer(browser), found.T_base_camera[0]
    placer.open(0)
    assert camera is not None
    return placer, camera, seen_from(folder, int(found.rows[0]), camera)


def test_joints_are_clicked_dragged_and_downloaded_and_place_the_camera(
    detection: tuple[Path, Detection], browser: Any, tmp_path: Path
) -> None:
    folder, found = detection
    _download_to(browser, tmp_path)
    page = (folder.parent / "found" / "index.html").as_uri()
    placer, camera, seen = placing(browser, page, folder, found)
    for joint in ("leg1.base", "leg2.base"):  # the next one is chosen by itself
        placer.click(seen[joint])
    placer.choose("leg4.base")
    placer.click(seen["leg3.base"])  # by mistake
    placer.drag(seen["leg3.base"], seen["leg4.base"])
    for joint in ("leg1.platform", "leg3.platform", "leg5.platform", "leg6.platform"):
        placer.choose(joint)
        placer.click(seen[joint])
    placer.press_delete("leg6.platform")
    table = _rows(placer.download("[data-landmarks]", tmp_path / "landmarks.csv"))
    clicked = {line["joint"]: np.array([float(line["u"]), float(line["v"])]) for line in table}
    assert list(clicked) == ["leg1.base", "leg2.base", "leg4.base", "leg1.platform",
                             "leg3.platform", "leg5.platform"]  # fmt: skip
    scale = placer.scale
    for joint, px in clicked.items():
        assert px == pytest.approx(seen[joint], abs=1.5 / scale), joint
    shutil.copytree(folder, tmp_path / "clicked")
    shutil.copy(tmp_path / "landmarks.csv", tmp_path / "clicked")
    placed = legcal.load_dataset(tmp_path / "clicked").measurements.views[0].T_base_camera
    assert placed is not None
    far, turned = pose_distance(placed, camera)
    assert far < 0.03
    assert turned < np.deg2rad(2.0)
    assert _errors(browser) == []


def test_a_served_page_draws_the_legs_and_saves_clicks(
    examined: tuple[Path, Examination], browser: Any, tmp_path: Path
) -> None:
    folder, examination = examined
    found = examination.detection
    assert found is not None
    shutil.copytree(folder, tmp_path / "set")
    dataset = replace(found.dataset, folder=tmp_path / "set")
    server = ClickServer(examination, replace(found, dataset=dataset), folder.parent / "found")
    threading.Thread(target=server.run, daemon=True).start()
    try:
        placer, camera, seen = placing(browser, str(server.address), folder, found)
        for joint in (*(f"leg{k}.base" for k in range(1, 7)), "leg1.platform", "leg3.platform"):
            placer.choose(joint)
            placer.click(seen[joint])
        lines = placer.until("return [...document.querySelectorAll('#placer .legs polyline')]"
                             ".map((line) => line.getAttribute('points'))")  # fmt: skip
        assert len(lines) >= 12
        placer.choose("leg5.platform")
        placer.click(seen["leg1.base"] + 30.0)
        said = "return document.querySelector('#placer [role=status].warning')?.textContent"
        assert "leg5.platform" in placer.until(said)
        placer.find("[name=undo]").click()
        placer.find("[name=save]").click()
        placer.until("return document.querySelector('#placer [role=status]').textContent"
                     ".includes('was saved')")  # fmt: skip
        placed = legcal.load_dataset(tmp_path / "set").measurements.views[0].T_base_camera
        assert placed is not None
        assert pose_distance(placed, camera)[0] < 0.03
        assert _errors(browser) == []
    finally:
        server.close()


# The viewer, against its real server


@contextmanager
def _shown(source: Subject, browser: Any) -> Iterator[ViewServer]:
    """Serve a source, and open it."""
    server = ViewServer(source, Address("127.0.0.1", 0))
    loop = threading.Thread(target=server.run, daemon=True)
    loop.start()
    try:
        _errors(browser)  # those of another page
        browser.get(str(server.address))
        yield server
    finally:
        browser.get("about:blank")  # it would look for its server
        server.close()
        loop.join(PATIENCE)
        assert not loop.is_alive()


def _press(browser: Any, name: str, key: str) -> None:
    browser.find_element("css selector", f"form[data-moves] [name={name}]").send_keys(key)


def _drawn(browser: Any) -> Any:
    """Return the lines of the legs that the canvas shows."""
    return browser.execute_script("return document.querySelector('canvas').layers[3].lines")


def test_sliders_of_the_viewer_move_the_machine(browser: Any) -> None:
    with _shown(open_source("3-upu"), browser) as server:
        before, lines = server.motion.posture, _drawn(browser)
        _press(browser, "q1", Keys.END)
        until(lambda: server.motion.posture.q[1] == 0.15)
        after = server.motion.posture
        np.testing.assert_allclose(after.q[[0, 2]], before.q[[0, 2]], atol=1e-9)
        assert np.abs(after.T.translation - before.T.translation).max() > 0.05
        until(lambda: _drawn(browser) != lines)
        there = after.T.apply(server.source.machine.B_platform)
        until(lambda: np.allclose([line[1] for line in _drawn(browser)], there, atol=1e-6))
        assert "At the end of the travel: leg2" in browser.find_element("css selector", "body").text
        _press(browser, "x2", Keys.ARROW_LEFT)
        until(lambda: server.motion.posture.T.translation[2] < after.T.translation[2] - 1e-6)
        np.testing.assert_allclose(
            server.motion.posture.T.translation[:2], after.T.translation[:2], atol=1e-9
        )
        home = browser.find_element("css selector", "form[data-moves] button")
        browser.execute_script("arguments[0].click()", home)  # what is said above may move it
        until(lambda: np.allclose(server.motion.posture.q, before.q))
        assert _errors(browser) == []


def test_a_result_is_shown_with_its_photographs(example_run: Run, browser: Any) -> None:
    with _shown(open_source(example_run.output, example_run.folder), browser) as server:
        first = server.motion.posture.T.as_matrix()
        _press(browser, "pose", Keys.ARROW_RIGHT)
        until(lambda: np.abs(server.motion.posture.T.as_matrix() - first).max() > 1e-3)
        (shown,) = server._photographs.at(1)
        until(lambda: shown["caption"] in browser.find_element("css selector", "body").text)
        lines = browser.find_elements("css selector", ".gallery polyline")
        assert len(lines) == len(shown["lines"]) > 0
        width = (
            "const i = new Image(); i.onload = () => arguments[1](i.width); i.src = arguments[0]"
        )
        assert browser.execute_async_script(width, f"/{shown['file']}") == min(
            shown["size"][0], 960
        )
        assert _errors(browser) == []


def test_only_this_machine_can_look() -> None:
    command = [sys.executable, "-m", "legcal", "view", "hexapod", "--no-browser", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:(\d+)", process.stdout.readline())
            assert found is not None
            port = int(found[1])
            with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as connection:
                connection.sendall(f"GET / HTTP/1.1\r\nHost: localhost:{port}\r\n\r\n".encode())
                assert connection.recv(12) == b"HTTP/1.0 200"
            # another address of this machine, at which all who listen everywhere answer
            with socket.socket() as other, pytest.raises(ConnectionRefusedError):
                other.connect(("127.0.0.2", port))
        finally:
            process.terminate()
            process.wait(PATIENCE)
    assert process.returncode == 0


# On a telephone: last, as the browser keeps something of its screen


def test_a_photograph_fills_the_editor_on_a_telephone(
    detection: tuple[Path, Detection], browser: Any
) -> None:
    narrow = {"width": 390, "height": 800, "deviceScaleFactor": 1, "mobile": True}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", narrow)
    try:
        editor = Editor(browser, detection[0].parent / "found" / "index.html")
        editor.open(0)
        stage = editor.find(".stage").size
        editor.close()
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    assert stage["width"] > 300
    assert stage["height"] > 200
