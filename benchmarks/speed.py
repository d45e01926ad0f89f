"""How fast photographs are turned into outlines, and whether memory grows with their number.

    OMP_NUM_THREADS=1 python benchmarks/speed.py [--memory N] [--ratio N]

The images of the sample dataset (1024 x 768, six legs) are decoded beforehand. Times are those of
the processor, for one image: what is seen of exposure and blur; legs recognised and cameras placed,
near rough camera poses or without any; the brief measurement of all outlines near there, the fit of
views to them with the search for missing legs, and the measurement with all care where the legs
truly are, which a joint fit misses by hundredths of a pixel. Of these images/s, "measured once" is
what a first measurement asks, recognition included, and "calibrate" is all that a calibration does
with an image once. Peak memory is that of processes which measure N and 3 N images that they read
one by one.

With --ratio the processor time of one whole ``legcal calibrate --fresh`` in a process of its own,
imports counted, is compared with that of the line segment detector of OpenCV on the same images at
full size, N times in turn: machines are noisy, and the ratio says more than either. A first one,
not counted, compiles the modules, as installing a package does.
"""

import argparse
import json
import multiprocessing
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import cv2
import numpy as np
from sample_outlines import TRUTH, true_scene
from scipy.spatial.transform import RigidTransform

from legcal.data.dataset import load_dataset
from legcal.data.outlines import no_outlines
from legcal.machine.kinematics import forward_kinematics
from legcal.perception.image_quality import measure_exposure
from legcal.perception.outline import measure_outlines
from legcal.perception.photographs import Photographs, measure_photographs
from legcal.perception.placement import Placement, group_views
from legcal.perception.recognition import place_views
from legcal.perception.view_fit import refine_views
from legcal.progress import no_progress
from legcal.workers import in_turn

DATASET = Path(__file__).resolve().parents[1] / "examples" / "hexapod"
N_MEMORY = 15

T = TypeVar("T")


def recognised(photographs: Photographs, scene: Placement) -> Placement:
    """Return the cameras and the legs that the images show."""
    search = photographs.search(scene)
    return place_views(search, photographs.detect, scene.T_base_camera, run=photographs.run)


def sample() -> tuple[Photographs, Placement]:
    """Return the images of the sample and the nominal scene, with rough camera poses."""
    dataset = load_dataset(DATASET)
    machine, measurements = dataset.machine, dataset.measurements
    platforms = [forward_kinematics(machine, q) for q in measurements.q]
    A = np.repeat(machine.A_base[None], measurements.n_rows, axis=0)
    B = np.array([T.apply(machine.B_platform) for T in platforms])
    rows = np.arange(measurements.n_rows)
    load = dataset.image_reader(rows.tolist())
    photographs = Photographs(machine, measurements, load, in_turn, rows, no_outlines())
    return photographs, Placement(A, B, tuple(view.T_base_camera for view in measurements.views))


def without_poses(scene: Placement) -> Placement:
    """Return a scene of whose cameras nothing is known."""
    nothing: tuple[RigidTransform | None, ...] = (None,) * len(scene.T_base_camera)
    return replace(scene, T_base_camera=nothing)


class Stopwatch:
    """Times of stages [ms of the processor an image]."""

    def __init__(self, n: int) -> None:
        self.n, self.spent = n, dict[str, float]()

    def __call__(self, stage: str, action: Callable[[], T]) -> T:
        """Return what an action gives, and take its time."""
        begin = time.process_time()
        result = action()
        self.spent[stage] = 1e3 * (time.process_time() - begin) / self.n
        print(f"{stage:44s}{self.spent[stage]:8.1f} ms", flush=True)
        return result

    def rate(self, words: str, *stages: str) -> None:
        """Print how many images a second some stages let through."""
        total = sum(self.spent[stage] for stage in stages)
        print(f"{words:44s}{total:8.1f} ms{1e3 / total:8.1f} images/s")


def measure_speed() -> None:
    """Print the time of every stage, and images a second."""
    photographs, scene = sample()
    rows = photographs.detect.tolist()
    decoded = [photographs.load(row) for row in rows]
    photographs = replace(photographs, load=decoded.__getitem__)
    watch = Stopwatch(len(rows))
    begin = np.array(rows[:3])
    measure_photographs(
        replace(photographs, detect=begin), scene, no_progress
    )  # what is computed only once
    exposures = watch("exposure and blur", lambda: [measure_exposure(image) for image in decoded])
    near = watch("recognition near poses", lambda: recognised(photographs, scene))
    watch(
        "recognition without",
        lambda: recognised(photographs, without_poses(scene)),
    )
    rough = {row: exposure.blur for row, exposure in zip(rows, exposures, strict=True)}
    search = photographs.search(scene, blur=rough)
    once, blur = watch(
        "outlines in brief", lambda: measure_outlines(search, near, rows, in_brief=True)
    )
    groups = group_views(photographs.measurements, photographs.detect, scene.T_base_camera, None)
    watch(
        "views fitted, and missing legs",
        lambda: refine_views(search, groups, near, once, in_brief=True),
    )
    watch("outlines with all care", lambda: measure_photographs(photographs, near, no_progress))
    view = photographs.measurements.view
    usual = [float(np.nanmedian(blur[view == v])) for v in range(len(near.T_base_camera))]
    truth = json.loads(TRUTH.read_text(encoding="utf-8"))
    fitted = Placement.of_fit(*true_scene(truth, photographs.measurements), usual)
    watch(
        "outlines with all care near a fit",
        lambda: measure_photographs(photographs, fitted, no_progress),
    )
    for words in ("near poses", "without"):
        begins = (
            "exposure and blur",
            f"recognition {words}",
            "outlines in brief",
            "views fitted, and missing legs",
        )
        watch.rate(f"measured once, {words}", *begins)
        watch.rate(f"calibrate, {words}", *begins, "outlines with all care near a fit")


def peak_memory(n: int) -> float:
    """Return the greatest memory of a process that measures n images [MB]."""
    photographs, scene = sample()
    rows = np.arange(n) % len(photographs.detect)
    measurements = photographs.measurements
    measurements = replace(
        measurements,
        image=tuple(measurements.image[row] for row in rows),
        view=measurements.view[rows],
        pose=np.arange(n),
        q=measurements.q[rows],
    )
    load = photographs.load
    photographs = replace(
        photographs,
        measurements=measurements,
        load=lambda row: load(int(rows[row])),
        detect=np.arange(n),
    )
    scene = replace(scene, A_base=scene.A_base[rows], B_base=scene.B_base[rows])
    for row in range(n):
        measure_exposure(photographs.load(row))
    measure_photographs(photographs, recognised(photographs, scene), no_progress)
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


def measure_memory(n: int) -> None:
    """Print the greatest memory for n and 3 n images."""
    context = multiprocessing.get_context("spawn")
    for count in (n, 3 * n):
        with context.Pool(1) as pool:
            print(
                f"{f'peak memory, {count} images':44s}{pool.apply(peak_memory, (count,)):8.0f} MB"
            )


def calibration_seconds() -> float:
    """Return the processor time of a whole calibration in a process of its own [s]."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "legcal", "calibrate", str(DATASET)]
        command += ["-o", f"{scratch}/out", "--fresh", "--no-report", "--quiet"]
        settings = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        settings |= {"PYTHONDONTWRITEBYTECODE": ""}
        subprocess.run(command, check=True, env=os.environ | settings, stdout=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def detector_seconds() -> float:
    """Return the processor time of the line segment detector on all images, one thread [s]."""
    files = sorted((DATASET / "images").iterdir())
    images = [
        image for f in files if (image := cv2.imread(str(f), cv2.IMREAD_GRAYSCALE)) is not None
    ]
    cv2.setNumThreads(1)
    detector = cv2.createLineSegmentDetector()
    begin = time.process_time()
    for image in images:
        detector.detect(image)
    return time.process_time() - begin


def measure_ratio(n: int) -> None:
    """Print the time of a calibration over that of the line segment detector, n times."""
    calibration_seconds()
    ratios = []
    for _ in range(n):
        ours, theirs = calibration_seconds(), detector_seconds()
        ratios.append(ours / theirs)
        print(f"calibrate {ours:6.2f} s, line segments {theirs:6.2f} s, ratio {ratios[-1]:5.2f}")
    print(f"median ratio {statistics.median(ratios):.2f}")


def main() -> None:
    """Measure speed, then memory."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--memory", type=int, default=N_MEMORY, help=f"images; {N_MEMORY}")
    parser.add_argument("--ratio", type=int, help="compare with line segments, so many times")
    options = parser.parse_args()
    if options.ratio:
        measure_ratio(options.ratio)
        return
    measure_speed()
    measure_memory(options.memory)


if __name__ == "__main__":
    main()
