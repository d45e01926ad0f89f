"""Base, platform and legs of a mechanism whose file does not name them, from its bodies alone.

The base is the body of the URDF's root, the platform the body where most chains end. Legs come in
the order of ``name_mot``, those without a motor after them in the order of the URDF; they are
named by what their joints' names have in front of the first underscore, where that tells them
apart. The frames stand on the legs whose joints span the largest triangle, or lie farthest apart
in a plane.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from legcal.errors import OutOfClass
from legcal.files.schema import is_plain_name
from legcal.geometry.types import Array
from legcal.mechanism.bodies import Bodies, Connection, frame_link, rigid_bodies
from legcal.mechanism.chain import Closure
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.parameters import n_frame_legs
from legcal.mechanism.plane import plane_of_motion
from legcal.mechanism.schema import LegcalBlock
from legcal.mechanism.topology import find_chains
from legcal.mechanism.urdf import Urdf

VIRTUAL = ("floating", "planar")
TIE = 1e-6  # of the largest triangle


def propose_block(
    urdf: Urdf, closures: Sequence[Closure], motors: Sequence[str], path: Path
) -> LegcalBlock:
    """Return the block ``legcal`` that a file without one means.

    Parameters
    ----------
    urdf : Urdf
        The tree.
    closures : sequence of Closure
        What coincides.
    motors : sequence of str
        The joints of ``name_mot``.
    path : Path
        The file, for messages.

    Returns
    -------
    LegcalBlock
        Without ``home``.

    Raises
    ------
    OutOfClass
        If no body is the platform of separate legs of the class.
    """
    virtual = [joint for joint in urdf.joints.values() if joint.type in VIRTUAL]
    bodies = rigid_bodies(urdf, closures, None)
    base = bodies.body_of[urdf.root]
    real = replace(bodies, connections=_without_virtual(bodies, urdf))
    carried = [bodies.body_of[j.child] for j in virtual]
    platform = _platform_body(real, base, carried, urdf, path)
    carrier = [j for j in virtual if {bodies.body_of[j.parent], bodies.body_of[j.child]} == {
        base, platform}]  # fmt: skip
    joint = carrier[0].name if carrier else None
    link = carrier[0].child if carrier else _main_link(urdf, closures, bodies, platform)
    bodies = rigid_bodies(urdf, closures, joint)
    chains = in_order(find_chains(bodies, urdf, urdf.root, link), motors, urdf)
    joints = [any_joint(chain) for chain in chains]
    names = _leg_names(joints)
    block = LegcalBlock(
        version=1,
        base=urdf.root,
        platform=link,
        platform_joint=joint,
        legs=dict(zip(names, joints, strict=True)),
    )
    return block.model_copy(update={"base_frame": propose_frame(names, chains)})


def propose_frame(names: Sequence[str], chains: Sequence[LegChain]) -> list[str]:
    """Return the legs to define frames with: those whose joints span most on base and platform.

    Parameters
    ----------
    names : sequence of str
        The legs.
    chains : sequence of LegChain
        Their joints.

    Returns
    -------
    list of str
        Three legs, or two of a planar mechanism, or all where there are fewer; the first ones
        where several span the same.
    """
    normals = plane_of_motion(chains)
    count = n_frame_legs(spatial=normals is None)
    if len(names) <= count:
        return list(names)
    ends = (
        np.array([chain.base.centre_near for chain in chains]),
        np.array([chain.platform.centre_far for chain in chains]),
    )
    if normals is not None:
        ends = _flat(ends[0], normals[0]), _flat(ends[1], normals[1])
    chosen = list(combinations(range(len(names)), count))
    spans = np.array([_span(ends[0][list(c)]) * _span(ends[1][list(c)]) for c in chosen])
    first = int(np.argmax(spans >= spans.max() * (1.0 - TIE)))
    return [names[j] for j in chosen[first]]


def in_order(chains: Sequence[LegChain], motors: Sequence[str], urdf: Urdf) -> list[LegChain]:
    """Return legs in the order of their motors, then those without one in the order of the URDF."""
    rank = {name: i for i, name in enumerate([*urdf.joints, *motors])}
    rank |= {name: i - len(motors) for i, name in enumerate(motors)}
    return sorted(chains, key=lambda chain: rank[any_joint(chain)])


def any_joint(chain: LegChain) -> str:
    """Return a joint that names a leg: its slider, or the first one that it has."""
    named = [s.connection.joint for s in chain.steps if s.connection.joint]
    return chain.motor or (named[0] if named else "")


def _without_virtual(bodies: Bodies, urdf: Urdf) -> tuple[Connection, ...]:
    """Return the connections that are joints of legs."""
    return tuple(
        c for c in bodies.connections if c.joint is None or urdf.joints[c.joint].type not in VIRTUAL
    )


def _platform_body(
    bodies: Bodies, base: str, carried: Sequence[str], urdf: Urdf, path: Path
) -> str:
    """Return the body where the legs end: every chain from the base to it is a leg of the class."""
    at: dict[str, list[str]] = {}
    for connection in bodies.connections:
        for here, there in (connection.bodies, connection.bodies[::-1]):
            at.setdefault(here, []).append(there)
    n_base = len(at.get(base, []))
    if n_base < 2:
        joints = "1 joint" if n_base == 1 else "no joint"
        raise OutOfClass(
            f"{path}: this is not a parallel mechanism: found {joints} on the base (the root of "
            "the URDF), needed one for each leg; write legcal.base, legcal.platform and "
            "legcal.legs if another link is the base."
        )
    meeting = [body for body in at if body != base and len(at[body]) > 2]
    candidates = meeting or [body for body in at if body != base]
    candidates = [body for body in candidates if body in carried] or candidates
    candidates.sort(key=lambda body: (base in at[body], -len(at[body])))  # arms come last
    found, reasons = [], list[OutOfClass]()
    for body in candidates:
        try:
            find_chains(bodies, urdf, urdf.root, body)
        except OutOfClass as error:
            reasons.append(error)
        else:
            found.append(body)
    if len(found) == 1:
        return found[0]
    if found:
        raise OutOfClass(
            f"{path}: no platform could be proposed: found several links where legs could end "
            f"({', '.join(found)}), needed one; write legcal.platform and legcal.legs."
        )
    if meeting:
        raise reasons[0]
    raise OutOfClass(
        f"{path}: this mechanism is outside the method: found one closed chain in which no link is "
        "a platform on legs, because on each side of any link more than a slider or a rod moves "
        "the joint at A; needed legs of type joint, slider or rod, joint; this machine cannot be "
        "calibrated this way."
    )


def _main_link(urdf: Urdf, closures: Sequence[Closure], bodies: Bodies, body: str) -> str:
    """Return the link of a body that most others hang from, or close on."""
    links = [link for link in urdf.links if bodies.body_of[link] == body]
    uses = dict.fromkeys(links, 0)
    for joint in urdf.joints.values():
        if joint.parent in uses:
            uses[joint.parent] += 1
    for closure in closures:
        for frame in (closure.frame_1, closure.frame_2):
            if frame_link(urdf, frame) in uses:
                uses[frame_link(urdf, frame)] += 1
    return max(links, key=lambda link: uses[link])


def _leg_names(joints: Sequence[str]) -> list[str]:
    """Return names of legs made of the names of their joints where these tell them apart."""
    fronts = [joint.split("_")[0] for joint in joints]
    if len(set(fronts)) == len(fronts) and all(map(is_plain_name, fronts)):
        return fronts
    return [f"leg{j + 1}" for j in range(len(joints))]


def _flat(points: Array, normal: Array) -> Array:
    """Return points without their heights along a normal."""
    return np.asarray(points - (points @ normal)[:, None] * normal)


def _span(points: Array) -> float:
    """Return the distance of two points [m], or twice the area of a triangle [m^2]."""
    if len(points) == 2:
        return float(np.linalg.norm(points[1] - points[0]))
    return float(np.linalg.norm(np.cross(points[1] - points[0], points[2] - points[0])))
