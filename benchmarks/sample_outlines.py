"""Outlines detected in the sample photographs, against their true places.

    python benchmarks/sample_outlines.py [WORKERS]

Runs both passes as the pipeline does: near the nominal model with the rough camera poses of the
dataset, then once more near the true scene (in place of a fit). Errors are positive towards
the inside of the leg. The truth is read here and in tests only.
"""

import json
import time
from collections import Counter
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rendered_cylinders import grey_levels
from scipy.spatial.transform import RigidTransform

from legcal.data.dataset import load_dataset
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array
from legcal.machine.kinematics import forward_kinematics
from legcal.machine.model import Machine
from legcal.perception.outline import measure_outlines
from legcal.perception.placement import Placement, Search
from legcal.perception.recognition import place_views
from legcal.vision.cylinder import EPSILON
from legcal.vision.image_file import Grey

ROOT = Path(__file__).resolve().parents[1]
DATASET = ROOT / "examples" / "hexapod"
TRUTH = ROOT / "tests" / "data" / "hexapod-truth" / "truth.json"
VISIBLE = 0.5  # share of a leg above which it ought to be found
WRONG = 2.0  # an edge this far from the outline is another edge [px]


def joint_centres(machine: Machine, measurements: Measurements) -> tuple[Array, Array]:
    """Return A and B of every row by the nominal model, (n_rows, n_legs, 3) [m]."""
    platforms = [forward_kinematics(machine, q) for q in measurements.q]
    A = np.repeat(machine.A_base[None], measurements.n_rows, axis=0)
    return A, np.array([T.apply(machine.B_platform) for T in platforms])


def true_scene(
    truth: dict[str, Any], measurements: Measurements
) -> tuple[Array, Array, list[RigidTransform]]:
    """Return A and B of every row and the camera poses, all in the true frame R_b [m]."""
    cameras = [np.array(camera["T_cam_base"]) for camera in truth["cameras"]]
    for T in cameras:
        T[:3, 3] *= 1e-3
    poses = [RigidTransform.from_matrix(T).inv() for T in cameras]
    by_file = {image["file"]: image for image in truth["images"]}
    centres = [
        [
            poses[view].apply(1e-3 * np.array([leg[key] for leg in by_file[name]["legs"]]))
            for key in ("A_cam", "B_cam")
        ]
        for name, view in zip(measurements.image, measurements.view, strict=True)
    ]
    stacked = np.array(centres)
    return stacked[:, 0], stacked[:, 1], poses


def errors(
    truth: dict[str, Any], measurements: Measurements, outlines: Outlines
) -> tuple[Array, Array]:
    """Return the errors at both ends of the used pieces (n, 2) [px], and how visible legs are."""
    by_file = {image["file"]: image for image in truth["images"]}
    error, visible = np.full((len(outlines), 2), np.nan), np.zeros(len(outlines))
    for i in range(len(outlines)):
        row = outlines.row[i]
        camera = measurements.views[measurements.view[row]].camera
        leg = by_file[measurements.image[row]]["legs"][outlines.leg[i]]
        visible[i] = leg["visible_fraction"]
        if np.all(np.isfinite(outlines.h[i])):
            h = np.array(leg[f"h{outlines.edge[i]}"])
            offset = camera.line_offset(h[None], camera.undistort(outlines.ends[i]))
            error[i] = EPSILON[outlines.edge[i] - 1] * offset
    return error, visible


def show(title: str, outlines: Outlines, error: Array, visible: Array, seconds: float) -> None:
    """Print the statistics of one pass."""
    used = outlines.used
    sigma = np.sqrt(np.stack([outlines.covariance[used][:, i, i] for i in (0, 1)], axis=1))
    e, pull = error[used], error[used] / sigma
    middle = e.mean(axis=1)
    print(f"{title}: {seconds:.2f} s")
    print(
        f"  parts with more than half visible {np.sum(visible > VISIBLE) // 2}, "
        f"found {np.sum(used & (visible > VISIBLE)) // 2}; "
        f"used with less visible {np.sum(used & (visible <= VISIBLE)) // 2}"
    )
    print(f"  wrong edges used (over {WRONG} px): {np.sum(np.abs(e).max(axis=1) > WRONG)}")
    for name, values in (("middle", middle), ("ends", e.ravel())):
        print(
            f"  {name}: within 0.1 px {np.mean(np.abs(values) < 0.1):.3f}, "
            f"spread {spread(values):.3f}, "
            f"median {np.median(values):+.3f}, rms {np.sqrt(np.mean(values**2)):.3f}, "
            f"largest {np.abs(values).max():.2f} px"
        )
    for edge in (1, 2):
        print(f"  edge {edge}: median {np.median(middle[outlines.edge[used] == edge]):+.3f} px")
    rms = np.sqrt(np.mean(pull**2))
    print(f"  error over claimed sigma, ends: robust {spread(pull, 0.0):.2f}, rms {rms:.2f}")
    for reason, n in Counter(str(why) for why in outlines.reason if why).most_common():
        print(f"  rejected: {reason} ({n // 2})")


def spread(values: Array, centre: float | None = None) -> float:
    """Return the robust standard deviation about the median or a given centre."""
    middle = float(np.median(values)) if centre is None else centre
    return 1.4826 * float(np.median(np.abs(values - middle)))


def main() -> None:
    """Measure both passes."""
    dataset = load_dataset(DATASET)
    machine, measurements = dataset.machine, dataset.measurements
    truth = json.loads(TRUTH.read_text())
    cylinders = [leg.cylinders for leg in machine.legs]
    wanted = np.ones((len(measurements.views), len(cylinders)), dtype=np.bool_)
    names = machine.leg_names

    def load(row: int) -> Grey:
        image = cv2.imread(str(DATASET / measurements.image[row]), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise FileNotFoundError(measurements.image[row])
        return grey_levels(image)

    A, B = joint_centres(machine, measurements)
    rough = [view.T_base_camera for view in measurements.views]
    search = Search(load, measurements, A, B, cylinders, wanted, names, machine.size)
    rows = np.arange(len(A))
    for words, hints in (("with", rough), ("without", [None] * len(rough))):
        start = time.perf_counter()
        placed = place_views(search, rows, hints)
        print(f"recognition {words} rough camera poses: {time.perf_counter() - start:.2f} s")
    start = time.perf_counter()
    first, _ = measure_outlines(search, placed, rows.tolist())
    seconds = time.perf_counter() - start
    show("near the nominal model", first, *errors(truth, measurements, first), seconds)
    A, B, poses = true_scene(truth, measurements)
    start = time.perf_counter()
    true = Placement(A, B, tuple(poses), joint_error=0.0)
    again, _ = measure_outlines(search, true, rows.tolist())
    seconds = time.perf_counter() - start
    show("near the true scene", again, *errors(truth, measurements, again), seconds)


if __name__ == "__main__":
    main()
