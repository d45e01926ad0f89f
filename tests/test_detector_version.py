"""What the detector measures in six fixed photographs: kept outlines depend on its version.

They are measured near a placement that is two millimetres off, quickly and with all care, and
close to the true one. Rounding on another processor moves some outlines by a few hundredths of a
pixel, so that it is most of them that may not change. Run this file to record the values again,
once DETECTOR_VERSION is raised.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.dataset import load_dataset
from legcal.data.outlines import no_outlines
from legcal.perception.photographs import DETECTOR_VERSION, Photographs, measure_photographs
from legcal.perception.placement import Placement
from legcal.progress import no_progress
from legcal.workers import in_turn

FOLDER = Path(__file__).parent / "data" / "six-photographs"
OFF, BLUR = 2e-3, 0.6  # of joint centres [m], and the blur that is taken to be known [px]
VALUES = FOLDER / "values.json"
# What rounding may change: verdicts, the median end, nine in ten [px], the median covariance.
VERDICTS, PX, MOST_PX, PART = 3, 2e-3, 0.05, 3e-3
RAISE = "outlines came out differently: raise DETECTOR_VERSION and record the values again"


def six_photographs() -> tuple[Photographs, Placement, Placement]:
    """Return them with a placement that is two millimetres off, and the true one as of a fit."""
    dataset = load_dataset(FOLDER)
    m, rows = dataset.measurements, np.arange(6)
    load = dataset.image_reader(rows.tolist())
    photographs = Photographs(dataset.machine, m, load, in_turn, rows, no_outlines())
    truth = json.loads((FOLDER / "truth.json").read_text(encoding="utf-8"))
    A, B = np.array([truth["A_base"]] * 6), np.array(truth["B_base"])
    poses = [truth["T_base_camera"][view.name] for view in m.views]
    cameras = [
        RigidTransform.from_components(pose["xyz"], Rotation.from_quat(pose["quat_xyzw"]))
        for pose in poses
    ]
    signs = np.resize([1.0, -1.0, -1.0, 1.0, -1.0], B.shape)
    rough = Placement(A + OFF * signs, B - OFF * signs, tuple(cameras))
    return photographs, rough, Placement.of_fit(A, B, cameras, (BLUR, BLUR))


def measured() -> dict[str, list[Any]]:
    """Return the outlines of the six photographs, measured in three ways."""
    photographs, rough, near = six_photographs()
    tables = {
        "quickly": measure_photographs(photographs, rough, no_progress, in_brief=True),
        "with care": measure_photographs(photographs, rough, no_progress),
        "near a fit": measure_photographs(photographs, near, no_progress),
    }
    return {
        name: [  # key, what is wrong, ends [px], covariance
            [*key, why.reason, *np.nan_to_num(ends, nan=-1.0).ravel().round(5).tolist(),
             *np.nan_to_num(C[[0, 0, 1], [0, 1, 1]], nan=-1.0).round(8).tolist()]
            for key, why, ends, C in zip(o.row_keys(), o.reason, o.ends, o.covariance, strict=True)
        ]
        for name, o in tables.items()
    }  # fmt: skip


def test_values_change_only_with_the_version() -> None:
    stored = json.loads(VALUES.read_text(encoding="utf-8"))
    assert stored["version"] == DETECTOR_VERSION, "record the values again: run this file"
    for way, found in measured().items():
        pairs = list(zip(found, stored[way], strict=True))
        assert all(new[:4] == old[:4] for new, old in pairs), way
        same = [(new, old) for new, old in pairs if new[4] == old[4] and new[5] >= 0.0]
        assert len(same) > 0.7 * len(pairs), way
        assert sum(new[4] != old[4] for new, old in pairs) <= VERDICTS, f"{way}: {RAISE}"
        new, old = (np.array([one[k][5:] for one in same]) for k in (0, 1))
        moved = np.abs(new[:, :4] - old[:, :4]).max(axis=1)
        assert np.median(moved) <= PX, f"{way}: {RAISE}"
        assert np.quantile(moved, 0.9) <= MOST_PX, f"{way}: {RAISE}"
        assert np.median(np.abs(new[:, 4:] / old[:, 4:] - 1.0)) <= PART, f"{way}: {RAISE}"


if __name__ == "__main__":
    lines = [
        f'"{name}": [\n' + ",\n".join(json.dumps(row) for row in rows) + "\n]"
        for name, rows in measured().items()
    ]
    text = ",\n".join([f'"version": {DETECTOR_VERSION}', *lines])
    VALUES.write_text("{\n" + text + "\n}\n", encoding="utf-8")
