"""Repeatability of outlines and leg axes, as in Table 1 of the paper (section 4.2).

    OMP_NUM_THREADS=1 python benchmarks/repeatability.py [--repeats 8] [--seed 0]

Photographs of a simulated hexapod from three places: six equally spaced orientations of every leg,
each photographed several times. Axes follow from both outlines of a leg by (4) and (5), and are
stated as in the paper: psi is the tilt out of the image plane, theta the angle in it, (x, 0, z) the
point M_LS. M_LS is left out where a leg is within 5 degrees of the plane y = 0 of the camera.

Standard deviations are pooled over legs and orientations; "median" and "largest" are of single
ones. The paper's upper bounds are 0.05 and 0.06 (degrees; "rad" as printed), 0.05 mm and 0.1 mm.
Repeats show only errors that differ between photographs of one pose: no bias of edges by light,
blur or shading. "claimed" includes an allowance for it.
"""

import argparse
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from legcal import detect
from legcal.calibration.detection import Detection
from legcal.data.outlines import axes_from_outlines
from legcal.geometry.types import Array, IntArray

N_ORIENTATIONS = 6
MIN_UPRIGHT = np.sin(np.radians(5.0))  # component of a leg along the image y axis
UNITS = {"psi": "deg", "theta": "deg", "x": "mm", "z": "mm", "outline": "px"}


def readings(n_repeats: int) -> str:
    """Return a table of readings that turns every leg in equal steps, repeats one by one."""
    lines = [",".join(f"leg{j}_prismatic" for j in range(1, 7))]
    for k in range(N_ORIENTATIONS):
        up, down, middle = 0.010 + 0.024 * k, 0.130 - 0.024 * k, 0.070
        lines += [",".join(f"{q:.3f}" for q in (up, middle, down) * 2)] * n_repeats
    return "\n".join(lines) + "\n"


def photographed(folder: Path, n_repeats: int, seed: int) -> Path:
    """Render the photographs and return the folder of their dataset."""
    (folder / "poses.csv").write_text(readings(n_repeats))
    options = ["--poses", str(folder / "poses.csv"), "--seed", str(seed), "-o", str(folder / "set")]
    command = [sys.executable, "-m", "legcal", "simulate", "hexapod", "--quiet", *options]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder / "set"


def orientations(found: Detection) -> IntArray:
    """Return which view and which readings (to a millimetre) each row has, (n_rows,)."""
    m = found.dataset.measurements
    rows = np.column_stack([m.view, m.q_of_poses[m.pose]]).round(3)
    return np.unique(rows, axis=0, return_inverse=True)[1].ravel().astype(np.intp)


def axis_deviations(found: Detection) -> Iterator[tuple[str, Array]]:
    """Yield the deviations of repeated axes of one leg in one orientation from their mean, (n,)."""
    machine = found.dataset.machine
    radii = {part: r for leg in machine.legs for part, r in leg.radius_along.items()}
    axes = axes_from_outlines(found.outlines, found.dataset.measurements, radii)
    groups = np.column_stack([orientations(found)[axes.row], axes.leg])
    for group in np.unique(groups, axis=0):
        chosen = np.all(groups == group, axis=1)
        u, M = axes.u[chosen], axes.M[chosen]
        psi, theta = np.arctan2(u[:, 2], np.hypot(*u[:, :2].T)), np.arctan2(-u[:, 0], u[:, 1])
        quantities = {"psi": np.degrees(psi), "theta": np.degrees(np.unwrap(theta))}
        if np.abs(u[:, 1]).min() > MIN_UPRIGHT:
            M_LS = M - u * (M[:, 1] / u[:, 1])[:, None]
            quantities |= {"x": 1e3 * M_LS[:, 0], "z": 1e3 * M_LS[:, 2]}
        for name, values in quantities.items():
            yield name, values - values.mean()


def outline_deviations(found: Detection) -> Iterator[tuple[Array, float]]:
    """Yield the same of repeated outlines, (n, 2) at their ends [px], and the claimed variance."""
    outlines, m = found.outlines, found.dataset.measurements
    place = orientations(found)[outlines.row]
    keys = list(zip(place, outlines.leg, outlines.part, outlines.edge, strict=True))
    for key in dict.fromkeys(keys):
        own = [i for i, other in enumerate(keys) if other == key and outlines.used[i]]
        if not own:
            continue
        camera = m.views[m.view[outlines.row[own[0]]]].camera
        common = camera.undistort(outlines.ends[own]).mean(axis=0)
        h = outlines.h[own]
        offsets = camera.line_offset(
            np.broadcast_to(h[:, None], (len(h), 2, 3)), np.broadcast_to(common, (len(h), 2, 2))
        )
        claimed = np.trace(outlines.covariance[own], axis1=1, axis2=2).mean() / 2.0
        yield offsets - offsets.mean(axis=0), float(claimed)


def main() -> None:
    """Render, measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--repeats", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="legcal-repeats-") as folder:
        found = detect(photographed(Path(folder), asked.repeats, asked.seed))
    samples: dict[str, list[Array]] = {name: [] for name in UNITS}
    for name, values in axis_deviations(found):
        samples[name].append(values[:, None])
    outlines = list(outline_deviations(found))
    samples["outline"] = [values for values, _ in outlines]
    print(f"{'':14}{'pooled':>10}{'median':>10}{'largest':>10}{'samples':>10}")
    for name, every in samples.items():
        several = [values for values in every if len(values) > 1]
        variances = np.array([np.mean(np.sum(v**2, axis=0)) / (len(v) - 1) for v in several])
        dof = np.array([len(values) - 1 for values in several])
        pooled = np.sqrt(dof @ variances / dof.sum())
        row = (pooled, np.sqrt(np.median(variances)), np.sqrt(variances.max()))
        cells = "".join(f"{value:10.3g}" for value in row)
        print(f"{f'{name} [{UNITS[name]}]':14}{cells}{len(several):10}")
    claimed = np.sqrt(np.mean([variance for values, variance in outlines if len(values) > 1]))
    print(f"outlines claim {claimed:.3g} px")


if __name__ == "__main__":
    main()
