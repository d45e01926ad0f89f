"""The travel of sliders whose file gives none: assumed from the size of the mechanism, and said."""

from collections.abc import Mapping, Sequence

import numpy as np
from lxml import etree
from scipy.spatial.transform import RigidTransform

from legcal.mechanism.urdf import Urdf

TRAVEL_OF_SIZE = 0.05


def sliders_without_travel(urdf: Urdf) -> list[str]:
    """Return the prismatic joints of a URDF that have no limits."""
    joints = urdf.joints.values()
    return [joint.name for joint in joints if joint.type == "prismatic" and joint.limits is None]


def assumed_travel(poses: Mapping[str, RigidTransform]) -> tuple[float, float]:
    """Return a travel for sliders that have none written: 5 % of the mechanism to either side.

    Parameters
    ----------
    poses : mapping of str to RigidTransform
        The links where the mechanism is closed.

    Returns
    -------
    tuple of float
        Lower and upper limit [m], to one significant digit.
    """
    points = np.array([pose.translation for pose in poses.values()])
    size = float(np.ptp(points, axis=0).max())
    reach = float(f"{TRAVEL_OF_SIZE * size:.0e}") if size > 0.0 else TRAVEL_OF_SIZE
    return -reach, reach


def travel_note(sliders: Sequence[str], travel: tuple[float, float]) -> str:
    """Return what the reader must know of sliders whose travel was assumed."""
    names = ", ".join(f"'{name}'" for name in sliders[:6])
    return (
        f"The file gives no travel for {len(sliders)} sliders ({names}): {travel[1]:g} m to either "
        "side of where it is closed was assumed; write their limits."
    )


def set_travel(
    robot: etree._Element, readings: Mapping[str, float], travel: tuple[float, float]
) -> None:
    """Write the travel of sliders about some readings [m] into a URDF."""
    for element in robot:
        name = str(element.get("name"))
        if element.tag == "joint" and name in readings:
            limit = element.find("limit")
            if limit is None:
                limit = etree.SubElement(element, "limit")
            limit.set("lower", repr(readings[name] + travel[0]))
            limit.set("upper", repr(readings[name] + travel[1]))
            for key in ("effort", "velocity"):
                limit.set(key, limit.get(key, "1000"))
