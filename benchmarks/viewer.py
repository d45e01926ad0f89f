"""How soon the viewer serves its page, and how fast a machine follows a slider that is dragged.

    python benchmarks/viewer.py [--model hexapod] [--starts 5] [--seconds 5]

The start is from the command to the first page served, with its bytes; the time of the processor
beside it does not count what else the computer does. The drag is scripted: one reading after the
other, each value as soon as the last one is answered, as the page asks; a frame is one answer, and
counted only if the platform has moved. With --result and --dataset the session of a
calibration is shown instead of a model.
"""

from __future__ import annotations

import argparse
import json
import re
import resource
import subprocess
import sys
import time
import urllib.request

import numpy as np

from legcal.files.quantity import SHOWN_IN
from legcal.viewer.server import Address
from legcal.viewer.source import open_source
from legcal.viewer.view_server import ViewServer

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
    """Return frames a second, and median and 95 % of the time of an answer [s]."""
    server = ViewServer(open_source(*words), Address("127.0.0.1", 0))
    motion, took = server.motion, list[float]()
    ranges, first = motion.ranges_of_readings(), motion.posture.q.copy()
    machine, frames = server.source.machine, set[bytes]()
    begun = time.perf_counter()
    while (now := time.perf_counter() - begun) < seconds:
        j = machine.motors[int(now / seconds * len(machine.motors))]
        room = AMPLITUDE * float(np.ptp(ranges[j]))
        middle = np.clip(first[j], ranges[j, 0] + room, ranges[j, 1] - room)
        wanted = middle + room * np.sin(2.0 * np.pi * now)
        size = SHOWN_IN[machine.legs[j].reading_unit][0]
        answer = server.answer(
            "/move", {}, json.dumps({"slider": f"q{j}", "value": size * wanted}).encode()
        )
        assert answer is not None
        took.append(time.perf_counter() - begun - now)
        frames.add(motion.posture.T.as_matrix().tobytes())
    rate = len(frames) / (time.perf_counter() - begun)
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
