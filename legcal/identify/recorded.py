"""The session that a dataset records: its readings, its cameras and the legs of its views."""

from __future__ import annotations

import numpy as np

from legcal.dataset.folder import Dataset
from legcal.geometry.types import Array
from legcal.identify.cameras import default_cameras
from legcal.identify.planned import joints_at, machine_near, radii
from legcal.identify.session import Session
from legcal.mechanism.kinematics import forward_kinematics_many
from legcal.mechanism.parametrization import parametrization_of


def recorded_session(dataset: Dataset) -> Session:
    """Return the session of a dataset.

    Parameters
    ----------
    dataset : Dataset
        Every view is taken to show the legs that it names, or all.

    Raises
    ------
    NotIdentifiable, DidNotConverge
        If the readings do not give the platform's poses.
    """
    mechanism, m = dataset.mechanism, dataset.measurements
    poses = forward_kinematics_many(mechanism, m.q[m.first_rows])
    to_Rb, from_Re = mechanism.T_base_Rb.inv(), mechanism.T_platform_Re
    home = to_Rb * mechanism.home * from_Re
    T = [to_Rb * pose * from_Re for pose in poses]
    legs, length, rng = machine_near(mechanism, home)
    used = np.unique(m.view)
    views = [m.views[v] for v in used]
    seen = np.array(
        [[view.legs is None or name in view.legs for name in mechanism.leg_names] for view in views]
    )
    A, B = joints_at(legs, home)
    shown = [np.flatnonzero(row).tolist() for row in seen]
    camera = default_cameras(A, B, shown, mechanism.spatial, rng)
    for v, view in enumerate(views):
        if view.T_base_camera is not None:
            camera[v] = (to_Rb * view.T_base_camera).translation
    return Session(
        leg_names=mechanism.leg_names,
        legs=legs,
        frame_legs=mechanism.frame_legs,
        parametrization=parametrization_of(mechanism),
        radius=radii(mechanism.legs, length),
        R=np.array([x.rotation.as_matrix() for x in T]),
        t=np.array([x.translation for x in T]),
        view=np.searchsorted(used, m.view),
        pose=m.pose,
        seen=seen,
        camera=camera,
        focal=np.array([_focal(view.camera.K) for view in views]),
        sigma_q=m.sigma_q,
    )


def _focal(K: Array) -> float:
    """Return the mean focal length [px]."""
    return float(np.sqrt(K[0, 0] * K[1, 1]))
