"""Six photographs that are kept with the tests, and where their legs and cameras truly are."""

import json
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data.dataset import load_dataset
from legcal.data.outlines import no_outlines
from legcal.perception.photographs import Photographs
from legcal.perception.placement import Placement
from legcal.workers import in_turn

FOLDER = Path(__file__).parent / "data" / "six-photographs"
OFF, BLUR = 2e-3, 0.6  # of joint centres [m], and the blur that is taken to be known [px]


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
