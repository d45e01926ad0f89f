"""How soon the viewer serves its page, and how fast a machine follows a slider that is dragged.

    python benchmarks/viewer.py [--model hexapod] [--starts 5] [--seconds 5]

The start is from the command to the first page served, with its bytes; the time of the processor
beside it does not count what else the computer does. The drag is scripted: 200 values a second of
one reading after the other, as a hand would, through the loop of the viewer; a frame is one posture
sent, and counted only if the platform has moved. With --result and --dataset the session of a
calibration is shown instead of a model.
"""

from __future__ import annotations

import argparse
import re
import resource
import subprocess
import sys
import threading
import time
import urllib.request
from functools import partial

import numpy as np

from legcal.viewer.address import Address
from legcal.viewer.source import open_source
from legcal.viewer.window import Window

HAND = 200.0  # values a second
AMPLITUDE = 0.2  # of the travel


def start(words: list[str]) -> tuple[float, float]:
    """Return how long a command takes until its page is served, and of the processor [s]."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-m", "legcal", "view", *words, "--no-browser", "--port", "0"]
    begun = time.perf_counter()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        found = re.search(r"http://[\d.]+:\d+", process.stdout.readline())
        assert found is not None
        with urllib.request.urlopen(found[0]) as page:
            assert b"<html" in page.read()
        took = time.perf_counter() - begun
        process.terminate()
    now = resource.getrusage(resource.RUSAGE_CHILDREN)
    return took, now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime


def drag(words: list[str], seconds: float) -> tuple[float, float, float]:
    """Return frames a second, and median and 95 % of the time of a frame's kinematics [s]."""
    window = Window(open_source(*words), Address("127.0.0.1", 0))
    motion, took = window.motion, []
    frames: set[bytes] = set()
    read = motion.read

    def timed(leg: int, value: float) -> None:
        begun = time.perf_counter()
        posture = read(leg, value)
        took.append(time.perf_counter() - begun)
        assert not posture.problem
        frames.add(posture.T.as_matrix().tobytes())

    loop = threading.Thread(target=window.run, daemon=True)
    loop.start()
    ranges, first = motion.ranges_of_readings(), motion.posture.q.copy()
    motors = window.source.machine.motors
    begun = time.perf_counter()
    while (now := time.perf_counter() - begun) < seconds:
        j = motors[int(now / seconds * len(motors))]
        room = AMPLITUDE * float(np.ptp(ranges[j]))
        middle = np.clip(first[j], ranges[j, 0] + room, ranges[j, 1] - room)
        wanted = middle + room * np.sin(2.0 * np.pi * now)
        window.ask(("leg", j), partial(timed, j, float(wanted)))
        time.sleep(1.0 / HAND)
    rate = len(frames) / (time.perf_counter() - begun)
    window.close()
    loop.join()
    return rate, float(np.median(took)), float(np.quantile(took, 0.95))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", default="hexapod")
    parser.add_argument("--result")
    parser.add_argument("--dataset")
    parser.add_argument("--starts", type=int, default=5)
    parser.add_argument("--seconds", type=float, default=5.0)
    given = parser.parse_args()
    shown = given.result or given.model
    with_option = [shown, "--dataset", given.dataset] if given.dataset else [shown]
    starts = np.array([start(with_option) for _ in range(given.starts)])
    usual, of_processor = np.median(starts, axis=0)
    print(
        f"{shown}: first page after {usual:.2f} s (best {starts[:, 0].min():.2f} s), "
        f"{of_processor:.2f} s of the processor"
    )
    rate, usual, slow = drag([shown, given.dataset] if given.dataset else [shown], given.seconds)
    print(f"{shown}: {rate:.0f} frames/s of a dragged slider, kinematics {1e3 * usual:.1f} ms "
          f"(95 %: {1e3 * slow:.1f} ms)")  # fmt: skip


if __name__ == "__main__":
    main()
