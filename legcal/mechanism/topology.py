"""From bodies to legs: what connects base and platform, joint by joint (section 2).

Nothing here reads names for meaning. A leg is a chain of bodies from base to platform; its joints
are found from where their axes meet, its length law from how its slider moves B past A.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.axes import CONCURRENT, JointGroup, Step, joint_group, meet
from legcal.mechanism.bodies import Bodies, Connection
from legcal.mechanism.urdf import Urdf


@dataclass(frozen=True, eq=False)
class LegChain:
    """The chain of one leg, and its geometry.

    Attributes
    ----------
    steps : tuple of Step
        Its joints from base to platform.
    bodies : tuple of str
        The body after every joint but the last: all of the leg, without base and platform.
    n_lower : int
        Number of joints that make up the joint at the base.
    base, platform : JointGroup
        The joints at both ends.
    slider : Step or None
        The prismatic joint; None for a leg of constant length.
    u_lower, u_upper : (3,) array
        For a slider, the direction in which its value moves the platform end, in the bodies on
        its base and platform side; else the direction from A to B.
    reach : float
        Position of B past A along that direction at joint value zero [m].
    """

    steps: tuple[Step, ...]
    bodies: tuple[str, ...]
    n_lower: int
    base: JointGroup
    platform: JointGroup
    slider: Step | None
    u_lower: Array
    u_upper: Array
    reach: float


def find_chains(bodies: Bodies, urdf: Urdf, base: str, platform: str) -> list[LegChain]:
    """Return the legs between two links, each understood as joint, slider, joint.

    Parameters
    ----------
    bodies : Bodies
        The bodies of the mechanism.
    urdf : Urdf
        The tree, for axes.
    base, platform : str
        Links.

    Raises
    ------
    OutOfClass
        If the mechanism is not a platform on separate legs of this kind.
    """
    ends = bodies.body_of[base], bodies.body_of[platform]
    if ends[0] == ends[1]:
        raise OutOfClass(
            f"{urdf.path}: this is not a parallel mechanism: found the platform '{platform}' fixed "
            f"to the base '{base}', needed legs between them; correct legcal.base or "
            "legcal.platform."
        )
    return [
        understand(steps, bodies, urdf.path) for steps in _paths(bodies, urdf, ends[0], ends[1])
    ]


def understand(steps: list[Step], bodies: Bodies, path: Path) -> LegChain:
    """Return the geometry of a leg from its joints in the order base to platform."""
    leg = next((s.connection.joint for s in steps if s.connection.joint), "") or ""
    sliders = [i for i, s in enumerate(steps) if s.connection.type == "prismatic"]
    if len(sliders) > 1 or (sliders and sliders[0] in (0, len(steps) - 1)):
        where = "two sliders" if len(sliders) > 1 else "a slider on the base or the platform itself"
        raise OutOfClass(
            f"{path}: the leg of joint '{leg}' is outside the method: found {where}, needed a "
            "joint whose centre is fixed in the base, one slider, and a joint whose centre is "
            "fixed in the platform; this machine cannot be calibrated this way."
        )
    if sliders:
        lower, upper = steps[: sliders[0]], steps[sliders[0] + 1 :]
    else:
        lower, upper = _split(steps)
    if not upper:
        raise OutOfClass(
            f"{path}: the leg of joint '{leg}' is outside the method: found no slider and not two "
            "separate joints, needed a leg of type joint, slider, joint, or a rod; this machine "
            "cannot be calibrated this way."
        )
    try:
        base, platform = joint_group(lower, leg), joint_group(upper, leg)
    except OutOfClass as error:
        raise OutOfClass([f"{path}: {problem}" for problem in error.problems]) from error
    slider = steps[sliders[0]] if sliders else None
    u_lower, u_upper, reach = _length_law(base, platform, slider, leg, path)
    inner = tuple(s.connection.bodies[s.far] for s in steps[:-1])
    return LegChain(
        tuple(steps), inner, len(lower), base, platform, slider, u_lower, u_upper, reach
    )


def _length_law(
    base: JointGroup, platform: JointGroup, slider: Step | None, leg: str, path: Path
) -> tuple[Array, Array, float]:
    """Return the direction of the leg in both halves and where B stands at joint value zero."""
    A, B = base.centre_far, platform.centre_near
    if slider is None:
        length = float(np.linalg.norm(B - A))
        if length < CONCURRENT:
            raise OutOfClass(
                f"{path}: the leg of joint '{leg}' is outside the method: found both its joints in "
                "one point, needed a distance between them; correct their origins."
            )
        u = (B - A) / length
        return u, u, length
    T_lower, T_upper = (slider.connection.T_body_joint[i] for i in (slider.near, slider.far))
    outward = 1.0 if slider.near == 0 else -1.0  # a joint moves its child, seen from its parent
    d_lower = outward * np.asarray(T_lower.rotation.apply(slider.axis))
    d_upper = outward * np.asarray(T_upper.rotation.apply(slider.axis))
    between = (T_lower * T_upper.inv()).apply(B) - A
    reach = float(between @ d_lower)
    miss = float(np.linalg.norm(between - reach * d_lower))
    if miss > CONCURRENT:
        raise OutOfClass(
            f"{path}: the leg of slider '{slider.connection.joint}' is outside the method: its "
            f"axis through the platform joint misses the base joint centre by {1e3 * miss:.4g} mm, "
            "needed at most 0.01 mm; correct the origins along the leg."
        )
    return d_lower, d_upper, reach


def _split(steps: list[Step]) -> tuple[list[Step], list[Step]]:
    """Split the joints of a rod where axes stop meeting."""
    for i in range(1, len(steps)):
        one, two = steps[i - 1], steps[i]
        spherical = "sphere" in (one.connection.type, two.connection.type)
        if spherical or not meet(one, two):
            return steps[:i], steps[i:]
    return steps, []


def _paths(bodies: Bodies, urdf: Urdf, base: str, platform: str) -> list[list[Step]]:
    """Return the joints of every leg from base to platform."""
    at: dict[str, list[Connection]] = {}
    for connection in bodies.connections:
        _refuse_unsupported(connection, urdf, base, platform)
        for body in connection.bodies:
            at.setdefault(body, []).append(connection)
    paths, used = [], set[int]()
    for first in at.get(base, []):
        body, steps, connection = base, list[Step](), first
        while True:
            used.add(id(connection))
            near = connection.bodies.index(body)
            steps.append(_step(connection, near, urdf))
            body = connection.bodies[1 - near]
            if body == platform:
                break
            onward = [c for c in at[body] if c is not connection]
            if body == base or len(onward) != 1 or id(onward[0]) in used:
                raise OutOfClass(_not_a_chain(urdf, first, body, base, len(onward)))
            connection = onward[0]
        paths.append(steps)
    stray = [c for c in bodies.connections if id(c) not in used]
    if stray:
        raise OutOfClass(
            f"{urdf.path}: this is not a platform on legs: found {_name(stray[0])} on no chain "
            "from base to platform, needed every joint on a leg; fix it or remove it."
        )
    return paths


def _step(connection: Connection, near: int, urdf: Urdf) -> Step:
    """Return a connection as passed from one of its bodies."""
    axis = urdf.joints[connection.joint].axis if connection.joint else np.zeros(3)
    return Step(connection, near, 1 - near, axis)


def _refuse_unsupported(connection: Connection, urdf: Urdf, base: str, platform: str) -> None:
    """Refuse joints that are not part of any leg."""
    if connection.joint is not None and urdf.joints[connection.joint].type in (
        "floating",
        "planar",
    ):
        raise OutOfClass(
            f"{urdf.path}: this mechanism is outside the method: found the "
            f"{urdf.joints[connection.joint].type} joint '{connection.joint}' inside it, needed "
            "at most the virtual one that carries the platform; name that one in "
            "legcal.platform_joint."
        )
    if connection.bodies[0] == connection.bodies[1]:
        raise OutOfClass(
            f"{urdf.path}: this mechanism is outside the method: found {_name(connection)} "
            "between two links that are rigidly connected, needed a joint that can move; remove it."
        )
    if set(connection.bodies) == {base, platform}:
        raise OutOfClass(
            f"{urdf.path}: this mechanism is outside the method: found {_name(connection)} "
            "directly between base and platform, needed legs; name it in legcal.platform_joint if "
            "it is the virtual joint that carries the platform."
        )


def _not_a_chain(urdf: Urdf, first: Connection, body: str, base: str, n_onward: int) -> str:
    """Return why the leg that starts at a joint is not a chain."""
    if body == base:
        found = "returns to the base"
    elif n_onward == 0:
        found = f"ends at link '{body}' without reaching the platform"
    else:
        found = f"shares link '{body}' with another leg or branches there"
    return (
        f"{urdf.path}: this is not a platform on separate legs: the chain that starts with "
        f"{_name(first)} {found}, needed one unbranched chain from base to platform for each leg; "
        "check closed_loop, legcal.base and legcal.platform."
    )


def _name(connection: Connection) -> str:
    """Return a joint or closure as a message names it."""
    if connection.joint is not None:
        return f"joint '{connection.joint}'"
    return f"the 3d closure number {(connection.closure or 0) + 1}"
