"""What a machine has besides legs, where its URDF shows none: balls at the joints and plates."""

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.mechanism.leg import Leg
from legcal.mechanism.model import Mechanism
from legcal.simulation.shapes import Cylinder, Sphere
from legcal.simulation.solids import Material, Solid, solids_of

_BALL = Material(albedo=0.06, specular=1.0, shininess=250.0, limb=0.2)
_POST = Material(albedo=0.04, specular=0.10, shininess=20.0, limb=0.3)
_PLATE = Material(albedo=0.09, specular=0.10, shininess=18.0, limb=0.1, texture=0.06)
_BALL_SIZE, _POST_SIZE = 1.4, 1.1  # in radii of the leg
_POST_LENGTH, _PLATE_THICKNESS, _PLATE_RIM = 4.5, 1.8, 3.5  # in radii of the thickest leg
_DEFAULT_RADIUS = 0.02  # of the distance between joints, where a leg shows no cylinder
_GAP = 1.5  # between the plates of a planar machine, in radii of the thickest leg
_FLAT = 0.2  # cosine between legs and plates below which the legs lie along the plates


def dressed(mechanism: Mechanism) -> tuple[Solid, ...]:
    """Return all that pictures show of a mechanism: its visuals, and what they lack.

    A link that has no visual of its own gets balls at the joint centres and, for three joints or
    more, a round plate that carries them on posts, on the side away from the legs. Both plates of a
    planar machine are below its legs, that of the base lowest, so that the legs are seen from
    above.

    Parameters
    ----------
    mechanism : Mechanism
        The mechanism.

    Raises
    ------
    ModelError
        As :func:`solids_of` does.
    """
    shown = solids_of(mechanism)
    bare = {mechanism.base, mechanism.platform} - {s.link for s in shown if s.leg is None}
    radii = np.array([_radius(leg, mechanism) for leg in mechanism.legs])
    added: list[Solid] = []
    if mechanism.base in bare:
        away = _away(mechanism.A_base, mechanism, -1.0)
        below = 0.0 if mechanism.spatial else _POST_LENGTH + _PLATE_THICKNESS + _GAP
        added += _end(mechanism.base, mechanism.A_base, radii, [True] * len(radii), away, below)
    if mechanism.platform in bare:
        balls = [leg.platform_joint != "" for leg in mechanism.legs]
        B = mechanism.B_platform
        away = _away(mechanism.home.apply(B), mechanism, 1.0)
        if away is not None:
            away = mechanism.home.rotation.inv().apply(away)
        added += _end(mechanism.platform, B, radii, balls, away)
    return (*shown, *added)


def _end(
    link: str,
    joints: Array,
    radii: Array,
    balls: Iterable[bool],
    away: Array | None,
    further: float = 0.0,
) -> list[Solid]:
    """Return the balls, posts and plate at one end of the legs, in its link.

    The posts are ``further`` radii of the thickest leg longer than they need to be.
    """
    solids = []
    for j, (joint, R, ball) in enumerate(zip(joints, radii, balls, strict=True)):
        if ball:
            at = RigidTransform.from_translation(joint)
            solids.append(Solid(f"{link}_ball{j + 1}", link, Sphere(_BALL_SIZE * R), at, _BALL))
    if away is None:
        return solids
    turn = Rotation.align_vectors([away], [[0.0, 0.0, 1.0]])[0]
    thickest = float(radii.max())
    outside = float((joints @ away).max()) + (_POST_LENGTH + further) * thickest
    for j, (joint, R) in enumerate(zip(joints, radii, strict=True)):
        length = outside - float(joint @ away)
        middle = RigidTransform.from_components(joint + 0.5 * length * away, turn)
        post = Cylinder(_POST_SIZE * float(R), length)
        solids.append(Solid(f"{link}_post{j + 1}", link, post, middle, _POST))
    middle = joints.mean(axis=0)
    across = joints - middle
    across = across - (across @ away)[:, None] * away
    thickness = _PLATE_THICKNESS * thickest
    size = float(np.linalg.norm(across, axis=1).max()) + _PLATE_RIM * thickest
    at = middle + (outside + 0.5 * thickness - float(middle @ away)) * away
    pose = RigidTransform.from_components(at, turn)
    solids.append(Solid(f"{link}_plate", link, Cylinder(size, thickness), pose, _PLATE))
    return solids


def _away(joints_base: Array, mechanism: Mechanism, side: float) -> Array | None:
    """Return the normal of the plane of joint centres, away from the legs, in the base frame.

    Parameters
    ----------
    joints_base : (n_legs, 3) array
        Joint centres of one end at home.
    mechanism : Mechanism
        The mechanism.
    side : float
        -1 for the base, +1 for the platform: from A to B times this is away from the legs. Of no
        account for planar machines.

    Returns
    -------
    (3,) array or None
        None where the joints lie on a line and no plate carries them.
    """
    if mechanism.base_normal is not None:
        return -mechanism.base_normal
    spread = joints_base - joints_base.mean(axis=0)
    _, sizes, axes = np.linalg.svd(spread)
    if len(joints_base) < 3 or sizes[1] < 0.05 * sizes[0]:
        return None
    normal = axes[2]
    legs = (mechanism.home.apply(mechanism.B_platform) - mechanism.A_base).mean(axis=0)
    cosine = float(normal @ legs) / max(float(np.linalg.norm(legs)), 1e-12)
    if abs(cosine) < _FLAT:  # the legs lie along the plates: one on each side
        cosine = float(normal[np.argmax(np.abs(normal))])
    return np.asarray(side * np.sign(cosine) * normal)


def _radius(leg: Leg, mechanism: Mechanism) -> float:
    """Return the radius of the thickest cylinder of a leg, or one that suits it [m]."""
    if leg.cylinders:
        return max(c.radius for c in leg.cylinders)
    length = np.linalg.norm(mechanism.home.apply(leg.B_platform) - leg.A_base)
    return _DEFAULT_RADIUS * float(length)
