"""Clicks on joints as a person would make them, where the nominal model has these."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal import forward_kinematics, load_dataset
from legcal.geometry.motions import look_at
from legcal.geometry.types import Array

COLUMNS = "view,image,joint,u,v,sigma"


def joints_in(folder: Path, row: int) -> dict[str, Array]:
    """Return the joints of a dataset at the readings of a row, (3,) in the base link [m].

    Where these do not give the pose of the platform it is at home.
    """
    dataset = load_dataset(folder, check_images=False)
    machine, q = dataset.machine, dataset.measurements.q[row]
    T = forward_kinematics(machine, q) if machine.is_determined else machine.home
    ends = {"base": machine.A_at(np.nan_to_num(q)), "platform": T.apply(machine.B_platform)}
    return {
        f"{name}.{end}": P
        for end, points in ends.items()
        for name, P in zip(machine.leg_names, points, strict=True)
    }


def camera_beside(folder: Path, angle: float, away: float = 3.0) -> RigidTransform:
    """Return T_base_camera of a camera beside the machine, so many leg lengths away."""
    machine = load_dataset(folder, check_images=False).machine
    joints = np.array(list(joints_in(folder, 0).values()))
    middle = joints.mean(axis=0)
    up = machine.upward
    x = np.cross(up, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    side = np.cos(angle) * x + np.sin(angle) * np.cross(up, x)
    side += (0.45 if machine.spatial else 1.0) * up
    return look_at(middle + away * machine.size * side, middle, up=up)


def seen_from(folder: Path, row: int, T_base_camera: RigidTransform) -> dict[str, Array]:
    """Return where the joints are seen in the image of a row [px]."""
    m = load_dataset(folder, check_images=False).measurements
    camera, T = m.views[m.view[row]].camera, T_base_camera.inv()
    return {name: camera.project(T.apply(P)) for name, P in joints_in(folder, row).items()}


def write_clicks(folder: Path, clicks: Mapping[int, Mapping[str, Array]], sigma: str = "") -> Path:
    """Write ``landmarks.csv`` of clicks in the images of rows."""
    m = load_dataset(folder, check_images=False).measurements
    lines = [COLUMNS]
    for row, pixels in clicks.items():
        place = f"{m.views[m.view[row]].name},{m.image[row]}"
        lines += [f"{place},{joint},{u:.3f},{v:.3f},{sigma}" for joint, (u, v) in pixels.items()]
    path = folder / "landmarks.csv"
    path.write_text("\n".join(lines) + "\n")
    return path
