"""Rough camera poses that the images contradict, in words."""

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import RigidTransform

FAR_OFF = (0.06, np.deg2rad(6.0))  # three times what a rough pose is good to: [m], angle
FAR_PART = 0.06  # of the distance of the camera, where that is more
BEFORE_FIT = 2.5  # times more, while the cameras are only where legs were recognised


def far_off(hint: RigidTransform, T_base_camera: RigidTransform, reach: float = 1.0) -> bool:
    """Say whether a rough pose is farther from a pose than rough ones are."""
    distance = float(np.linalg.norm(T_base_camera.translation))
    apart, angle = _apart(hint, T_base_camera)
    nearest, part = reach * FAR_OFF[0], reach * FAR_PART
    return apart > max(nearest, part * distance) or angle > reach * FAR_OFF[1]


def hint_notes(
    names: Sequence[str],
    hints: Sequence[RigidTransform | None],
    cameras: Sequence[RigidTransform | None],
    reach: float = 1.0,
) -> list[str]:
    """Return what is to be said of rough poses that are wrong.

    Parameters
    ----------
    names : sequence of str
        The views.
    hints : sequence of RigidTransform or None
        T_base_camera as given, roughly.
    cameras : sequence of RigidTransform or None
        T_base_camera as the images have it; None where a view could not be placed.
    reach : float
        How many times farther than rough poses are they may be.
    """
    notes = []
    for name, hint, T in zip(names, hints, cameras, strict=True):
        if hint is None or T is None or not far_off(hint, T, reach):
            continue
        apart, angle = _apart(hint, T)
        x, y, z = T.translation
        other = next(
            (
                other
                for other, camera in zip(names, cameras, strict=True)
                if other != name and camera is not None and not far_off(hint, camera, reach)
            ),
            None,
        )
        remedy = (
            "correct it in dataset.yaml"
            if other is None
            else f"it suits view {other}: check whether views or their images were exchanged"
        )
        notes.append(
            f"view {name}: its T_base_camera is wrong: found it {1e3 * apart:.0f} mm and "
            f"{np.degrees(angle):.0f} deg from where the images put the camera (xyz: [{x:.3f}, "
            f"{y:.3f}, {z:.3f}]), needed a rough pose; {remedy}."
        )
    return notes


def _apart(one: RigidTransform, other: RigidTransform) -> tuple[float, float]:
    """Return distance [m] and angle [rad] between two poses."""
    off = one.inv() * other
    return float(np.linalg.norm(off.translation)), float(off.rotation.magnitude())
