"""A dataset of a simulated hexapod with a table of axes in place of images."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from legcal.data.axes import write_axes
from legcal.machine import load_mechanism
from legcal.simulation.folder import write_session
from legcal.simulation.hexapod import (
    PaperHexapod,
    cameras_around,
    hexapod,
    hexapod_session,
    perturb,
)
from legcal.simulation.observe import TableNoise

ROOT = Path(__file__).parents[1]
MODEL = ROOT / "models" / "hexapod.yaml"


def write_axes_dataset(folder: Path, *, n_poses: int = 10, images: bool = False) -> PaperHexapod:
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
    session = hexapod_session(machine, cameras, rng, noise=TableNoise(), n_poses=n_poses)
    nominal, m = load_mechanism(MODEL), session.measurements
    names = tuple(f"images/{row}.png" if images else "" for row in range(m.n_rows))
    labels = tuple(f"p{pose}" for pose in range(m.n_poses))
    measurements = replace(m, image=names, pose_labels=labels)
    views = [
        replace(view, T_base_camera=nominal.T_base_Rb * view.T_base_camera)
        for view in m.views
        if view.T_base_camera is not None
    ]
    folder.mkdir()
    write_session(
        folder,
        nominal,
        str(MODEL),
        replace(measurements, views=tuple(replace(view, legs=None) for view in views)),
    )
    write_axes(folder / "axes.csv", session.axes, measurements, nominal.leg_names)
    return machine
