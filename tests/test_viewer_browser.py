"""The viewer in a browser, against its real server."""

import re
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from browser import PATIENCE, chromium, errors
from hexapod_example import Run

from legcal.viewer.address import Address
from legcal.viewer.source import Source, open_source
from legcal.viewer.window import Window

pytestmark = pytest.mark.system

SIZE = 760, 480  # [px]: a window that is drawn quickly without a graphics card


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'legcal[view]')")
    with chromium() as found:
        found.set_window_size(*SIZE)
        yield found


@contextmanager
def _shown(source: Source, browser: Any) -> Iterator[Window]:
    """Serve a source, and open it."""
    window = Window(source, Address("127.0.0.1", 0))
    loop = threading.Thread(target=window.run, daemon=True)
    loop.start()
    try:
        errors(browser)  # those of another page
        browser.get(str(window.address))
        _wait(lambda: browser.find_elements("css selector", "canvas"))
        _wait(lambda: _control(browser, "z"))
        yield window
    finally:
        browser.get("about:blank")  # it would look for its server
        window.close()
        loop.join(PATIENCE)
        assert not loop.is_alive()


def _wait(condition: Callable[[], Any]) -> Any:
    end = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < end
        time.sleep(0.05)
    return found


def _control(browser: Any, label: str) -> Any:
    """Return the thumb of a slider by its label, None where there is none."""
    return browser.execute_script(
        """for (const label of document.querySelectorAll("label"))
             if (label.textContent.trim() === arguments[0]) {
               let row = label;
               while (row && !row.querySelector("[role=slider]")) row = row.parentElement;
               return row && row.querySelectorAll("[role=slider]").length === 1
                 ? row.querySelector("[role=slider]") : null;
             }
           return null;""",
        label,
    )


def _press(browser: Any, label: str, key: str) -> None:
    thumb = _control(browser, label)
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", thumb)
    browser.execute_script("arguments[0].focus()", thumb)
    thumb.send_keys(key)


def test_sliders_move_the_machine(browser: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    with _shown(open_source("3-upu"), browser) as window:
        before = window.motion.posture
        _press(browser, "leg2", Keys.END)
        _wait(lambda: window.motion.posture.q[1] == 0.15)
        after = window.motion.posture
        np.testing.assert_allclose(after.q[[0, 2]], before.q[[0, 2]], atol=1e-9)
        assert np.abs(after.T.translation - before.T.translation).max() > 0.05
        _press(browser, "z", Keys.ARROW_LEFT)
        _wait(lambda: window.motion.posture.T.translation[2] < after.T.translation[2] - 1e-6)
        np.testing.assert_allclose(
            window.motion.posture.T.translation[:2], after.T.translation[:2], atol=1e-9
        )
        assert errors(browser) == []


def test_a_result_is_shown_with_its_photographs(example_run: Run, browser: Any) -> None:
    from selenium.webdriver.common.keys import Keys

    with _shown(open_source(example_run.output, example_run.folder), browser) as window:
        first = window.motion.posture.T.as_matrix()
        _press(browser, "pose", Keys.ARROW_RIGHT)
        _wait(lambda: np.abs(window.motion.posture.T.as_matrix() - first).max() > 1e-3)
        _wait(lambda: "Pose 2 of 45" in browser.find_element("css selector", "body").text)
        assert window.seen.beside is not None
        assert errors(browser) == []


def test_only_this_machine_can_look() -> None:
    pytest.importorskip("viser", reason="viser is not installed (pip install 'legcal[view]')")
    command = [sys.executable, "-m", "legcal", "view", "hexapod", "--no-browser", "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"http://127\.0\.0\.1:(\d+)", process.stdout.readline())
            assert found is not None
            port = int(found[1])
            with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE) as connection:
                connection.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
                assert connection.recv(12) == b"HTTP/1.1 200"
            # another address of this machine, at which all who listen everywhere answer
            with socket.socket() as other, pytest.raises(ConnectionRefusedError):
                other.connect(("127.0.0.2", port))
        finally:
            process.terminate()
            process.wait(PATIENCE)
    assert process.returncode == 0
