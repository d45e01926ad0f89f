"""A dataset of a simulated hexapod with a table of axes in place of images."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from legcal.data.axes import write_axes
from legcal.data.measurements import Measurements
from legcal.files import motion_to_xyz_quat
from legcal.machine import load_mechanism
from legcal.simulation.cameras import cameras_around
from legcal.simulation.machine import Machine, hexapod, perturb
from legcal.simulation.studies.paper import simulate_session
from legcal.simulation.table_noise import TableNoise

ROOT = Path(__file__).parents[1]
MODEL = ROOT / "models" / "hexapod.yaml"


def write_axes_dataset(folder: Path, *, n_poses: int = 10, images: bool = False) -> Machine:
    """Write a dataset whose machine is up to 2 mm off its drawing; return that machine.

    Parameters
    ----------
    folder : Path
        Where to write; created.
    n_poses : int
        Poses, each with one image, for each of three views.
    images : bool
        Name an image in every row; there are no files of these names.
    """
    rng = np.random.default_rng(11)
    machine = perturb(hexapod(), rng, 0.002)
    cameras = cameras_around(machine, rng)
    session = simulate_session(machine, cameras, rng, noise=TableNoise(), n_poses=n_poses)
    nominal, m = load_mechanism(MODEL), session.measurements
    names = tuple(f"images/{row}.png" if images else "" for row in range(m.n_rows))
    labels = tuple(f"p{pose}" for pose in range(m.n_poses))
    measurements = replace(m, image=names, pose_labels=labels)
    folder.mkdir()
    K = m.views[0].camera.K.ravel().tolist()
    camera = {
        "image_width": 1024,
        "image_height": 768,
        "camera_matrix": {"rows": 3, "cols": 3, "data": K},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
    }
    (folder / "camera_info.yaml").write_text(yaml.safe_dump(camera))
    views: dict[str, Any] = {}
    for view in m.views:
        assert view.T_base_camera is not None
        rough = motion_to_xyz_quat(nominal.T_base_Rb * view.T_base_camera)
        views[view.name] = {"camera": "camera_info.yaml", "T_base_camera": rough}
    entry = {
        "legcal_dataset": 1,
        "mechanism": str(MODEL),
        "measurements": "measurements.csv",
        "encoder_sigma": m.sigma_q,
        "views": views,
    }
    (folder / "dataset.yaml").write_text(yaml.safe_dump(entry, sort_keys=False))
    joints = [leg.prismatic or "" for leg in nominal.legs]
    _write_readings(folder / "measurements.csv", measurements, joints)
    write_axes(folder / "axes.csv", session.axes, measurements, nominal.leg_names)
    return machine


def _write_readings(path: Path, m: Measurements, joints: list[str]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["view", "image", "pose", *joints])
        for row in range(m.n_rows):
            place = [m.views[m.view[row]].name, m.image[row], m.pose_labels[m.pose[row]]]
            writer.writerow([*place, *(repr(q) for q in m.q[row].tolist())])
