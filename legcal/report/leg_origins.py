"""Where the joints of a URDF stand once its legs have other numbers (section 2).

A joint centre moves, and an axis turns, with the joint that ties the leg to base or platform. The
length of a leg and its twist are a screw along the leg, at the slider or in the rod. All joints
inside the leg stay as they are to each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import OutOfClass
from legcal.geometry.types import Array
from legcal.mechanism.leg import Leg
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.leg_geometry import LegGeometry, geometry_of
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parametrization import in_links, twist_after
from legcal.report.leg_handles import Handle, Handles

ROUNDING = 1e-14  # [rad]: what turns less does not turn


@dataclass(frozen=True, eq=False)
class Motion:
    """A rigid motion in a frame: p -> about + R (p - about) + shift.

    Attributes
    ----------
    shift, about : (3,) array
        Displacement, and the point that it is the displacement of [m].
    turn : Rotation or None
        R; None where nothing turns, so that nothing is rounded.
    """

    shift: Array
    about: Array
    turn: Rotation | None = None

    def inv(self) -> Motion:
        """Return the motion back."""
        turn = None if self.turn is None else self.turn.inv()
        return Motion(-self.shift, self.about + self.shift, turn)

    def seen_from(self, T_to_from: RigidTransform) -> Motion:
        """Return the same motion in another frame."""
        R = T_to_from.rotation
        turn = None if self.turn is None else R * self.turn * R.inv()
        return Motion(
            np.asarray(R.apply(self.shift)), np.asarray(T_to_from.apply(self.about)), turn
        )

    def of(self, T: RigidTransform) -> RigidTransform:
        """Return a pose after the motion."""
        if self.turn is None:
            return RigidTransform.from_components(T.translation + self.shift, T.rotation)
        arm = self.turn.apply(T.translation - self.about)
        return RigidTransform.from_components(self.about + arm + self.shift, self.turn * T.rotation)


@dataclass(frozen=True, eq=False)
class MovedOrigin:
    """The new origin of a joint.

    Attributes
    ----------
    T_parent_origin : RigidTransform
        In its parent link [m].
    is_turned : bool
        Whether its orientation changes too.
    """

    T_parent_origin: RigidTransform
    is_turned: bool


def moved_origins(mechanism: Mechanism, legs: Sequence[LegGeometry]) -> dict[str, MovedOrigin]:
    """Return the origin of every joint that carries a number of a leg.

    Parameters
    ----------
    mechanism : Mechanism
        The nominal mechanism, as loaded.
    legs : sequence of LegGeometry
        The legs as they are to be, in R_b and R_e, in the order of ``mechanism.legs``. Axes may
        be given either way round.

    Returns
    -------
    dict of str to MovedOrigin
        By joint; those that stay where they are, are among them.

    Raises
    ------
    OutOfClass
        If the tree ties a leg to base or platform where no origin moves that leg alone.
    """
    handles = Handles(mechanism)
    found: dict[str, MovedOrigin] = {}

    def move(handle: Handle, motion: Motion, body: str) -> None:
        """Move a joint by a motion that is given in a link of its body."""
        joint, T_body_link = handle.joint, handles.bodies.T_body_link
        before = found.get(joint.name, MovedOrigin(joint.T_parent_origin, False))
        there = T_body_link[joint.parent].inv() * T_body_link[body]
        seen = motion.seen_from(there) if body != joint.parent else motion
        seen = seen.inv() if handle.is_inverse else seen
        found[joint.name] = MovedOrigin(
            seen.of(before.T_parent_origin), before.is_turned or seen.turn is not None
        )

    for leg, chain, wanted in zip(
        mechanism.legs, mechanism.leg_chains, in_links(mechanism, legs), strict=True
    ):
        at_base, at_platform = _ends(leg, wanted)
        grown = wanted.q0 - leg.q0, _twisted(leg, wanted, at_platform)
        if chain.slider is not None:
            move(*_at_slider(handles, leg, chain, grown))
        elif any(grown):
            move(*_in_rod(handles, leg, chain, grown))
        first, last = chain.steps[0], chain.steps[-1]
        base, platform = mechanism.base, mechanism.platform
        move(handles.of(first, first.near, base, leg.name), at_base, base)
        move(handles.of(last, last.far, platform, leg.name), at_platform, platform)
    return found


def _ends(leg: Leg, wanted: LegGeometry) -> tuple[Motion, Motion]:
    """Return how the ends of a leg move in the links of base and platform."""
    is_fixed = leg.platform_joint == ""
    return (
        Motion(wanted.A - leg.A_base, leg.A_base, _turn(leg.base_axis, wanted.base_axis)),
        Motion(
            wanted.B - leg.B_platform,
            leg.B_platform,
            _turn(leg.platform_axis, wanted.platform_axis, directed=is_fixed),
        ),
    )


def _turn(axis: Array | None, wanted: Array | None, *, directed: bool = False) -> Rotation | None:
    """Return the smallest rotation of an axis, a line unless it is directed, onto another."""
    if axis is None or wanted is None:
        return None
    if not directed and axis @ wanted < 0.0:
        wanted = -wanted
    normal = np.cross(axis, wanted)
    sine = float(np.linalg.norm(normal))
    angle = float(np.arctan2(sine, axis @ wanted))
    return None if angle < ROUNDING else Rotation.from_rotvec(angle / sine * normal)


def _twisted(leg: Leg, wanted: LegGeometry, at_platform: Motion) -> float:
    """Return how far the upper half of a leg turns about it, beside what its end does [rad]."""
    if leg.twist is None or wanted.twist is None:
        return 0.0
    carried = leg.twist
    if at_platform.turn is not None:
        carried = float(twist_after(geometry_of(leg), at_platform.turn) or 0.0)
    twist = wanted.twist - carried
    twist -= np.pi * np.round(twist / np.pi)
    return float(twist) if abs(twist) > ROUNDING else 0.0


def _screw(along: Array, point: Array, grown: tuple[float, float]) -> Motion:
    """Return the motion of the upper half of a leg: growth along its line, and turn about it."""
    growth, twist = grown
    turn = None if twist == 0.0 else Rotation.from_rotvec(twist * along)
    return Motion(growth * along, point, turn)


def _at_slider(
    handles: Handles, leg: Leg, chain: LegChain, grown: tuple[float, float]
) -> tuple[Handle, Motion, str]:
    """Return what moves the upper half of a leg at its slider, how, and the body that says so."""
    slider = chain.slider
    if slider is None:
        raise ValueError("a rod has no slider")
    body = slider.connection.bodies[0]  # that of the joint's parent
    if slider.near == 0:
        along, point = chain.u_lower, chain.base.centre_far
    else:
        along, point = chain.u_upper, chain.platform.centre_near
    handle = handles.of(slider, 0, body, leg.name)._replace(is_inverse=slider.near != 0)
    return handle, _screw(leg.sign * along, point, grown), body


def _in_rod(
    handles: Handles, leg: Leg, chain: LegChain, grown: tuple[float, float]
) -> tuple[Handle, Motion, str]:
    """Return what moves the upper end of a rod against its lower one, how, and the body."""
    below, above = chain.steps[chain.n_lower - 1], chain.steps[chain.n_lower]
    body = chain.bodies[chain.n_lower - 1]
    try:
        handle = handles.of(above, above.near, handles.link(below, below.far), leg.name)
    except OutOfClass:
        handle = handles.of(below, below.far, handles.link(above, above.near), leg.name)
        handle = handle._replace(is_inverse=not handle.is_inverse)
    return handle, _screw(chain.u_lower, chain.base.centre_far, grown), body
