"""The viewer in a browser, against its real server."""

import re
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest
from browser import PATIENCE, chromium, errors, until
from hexapod_example import Run
from selenium.webdriver.common.keys import Keys

from legcal.exports.subject import Subject
from legcal.viewer.server import Address
from legcal.viewer.source import open_source
from legcal.viewer.view_server import ViewServer

pytestmark = pytest.mark.system


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as found:
        yield found


@contextmanager
def _shown(source: Subject, browser: Any) -> Iterator[ViewServer]:
    """Serve a source, and open it."""
    server = ViewServer(source, Address("127.0.0.1", 0))
    loop = threading.Thread(target=server.run, daemon=True)
    loop.start()
    try:
        errors(browser)  # those of another page
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


def test_sliders_move_the_machine(browser: Any) -> None:
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
        browser.find_element("css selector", "form[data-moves] button").click()
        until(lambda: np.allclose(server.motion.posture.q, before.q))
        assert errors(browser) == []


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
        modes = browser.find_elements("css selector", "select[name=mode] option")
        assert len(modes) == 1 + len(server.scene.directions)
        assert errors(browser) == []


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
