"""The legs of a machine as a graph: chains of joints between bodies, plane of motion, proposals.

Defaults for base, platform and legs: the base is the root body of the URDF, the platform the body
where most chains end. Legs are in the order of ``name_mot``, followed by legs without a motor in
the order of the URDF; their names are the prefixes of their joint names before the first
underscore, if these are distinct. The frames are defined by the legs whose joints span the largest
triangle, or are farthest apart in a plane.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, pairwise
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.errors import OutOfClass
from legcal.files.schema import is_plain_name
from legcal.geometry.lines import cross
from legcal.geometry.types import Array
from legcal.machine.chain import Bodies, Closure, Connection, rigid_bodies
from legcal.machine.classification import (
    NOT_CALIBRATED,
    classify_leg,
    is_actuator,
    joint_tolerance,
    off_square,
    parallel,
    undirected,
)
from legcal.machine.files import LegcalBlock
from legcal.machine.leg import Axis, LegChain
from legcal.machine.parameters import n_frame_legs
from legcal.machine.spanning_tree import Source, connected
from legcal.machine.urdf import VIRTUAL, Urdf

Normals = tuple[Array, Array]
TIE = 1e-6  # difference of equally large triangles, relative to the largest


MAX_JOINTS_OF_LEG = 12  # three revolutes for a sphere at each end and a slider are seven


def find_chains(
    bodies: Bodies, urdf: Urdf, base: str, platform: str, motors: Sequence[str]
) -> list[LegChain]:
    """Return the legs between two links, each classified as joint, slider or rod, joint.

    One of the *motors* on the base may carry several rods.
    """
    ends = bodies.body_of[base], bodies.body_of[platform]
    if ends[0] == ends[1]:
        raise OutOfClass(
            "this is not a parallel mechanism",
            f"the platform '{platform}' fixed to the base '{base}'",
            "legs between them",
            urdf.wording.correct_ends,
            urdf.path,
        )
    origin = bodies.T_body_link[platform][:3, 3]
    within = joint_tolerance(_joints_on(bodies, end) for end in ends)
    return [
        classify_leg(steps, origin, urdf.path, within, motors)
        for steps in _paths(bodies, urdf, *ends, motors, within)
    ]


def _joints_on(bodies: Bodies, body: str) -> list[Array]:
    """Return the positions of the joints of a body in it, (3,) each [m]."""
    return [
        T[:3, 3]
        for connection in bodies.connections
        for end, T in zip(connection.bodies, connection.T_body_joint, strict=True)
        if end == body
    ]


def _paths(
    bodies: Bodies, urdf: Urdf, base: str, platform: str, motors: Sequence[str], within: float
) -> list[list[Connection]]:
    """Return the joints of every leg from base to platform."""
    at: dict[str, list[Connection]] = {}
    for connection in bodies.connections:
        _refuse_unsupported(connection, urdf, base, platform)
        for body in connection.bodies:
            at.setdefault(body, []).append(connection)
    begun: list[tuple[str, list[Connection], Connection]] = []
    used = set[int]()
    for first in at.get(base, []):
        step = first.from_body(base)
        body = step.bodies[1]
        if body not in (base, platform) and is_actuator(step, motors) and len(at[body]) > 2:
            used.add(id(first))
            begun += [(body, [step], onward) for onward in at[body] if onward is not first]
        else:
            begun.append((base, [], first))
    paths = []
    for body, steps, connection in begun:
        while True:
            used.add(id(connection))
            steps.append(connection.from_body(body))
            body = steps[-1].bodies[1]
            if body == platform:
                break
            if len(steps) > MAX_JOINTS_OF_LEG:
                raise OutOfClass(
                    "this is not a platform on legs",
                    f"a leg of more than {MAX_JOINTS_OF_LEG} joints from {_name(steps[0])}",
                    "joint, slider, joint",
                    "give the mechanism alone",
                    urdf.path,
                )
            onward = [c for c in at[body] if c is not connection]
            if body == base or len(onward) != 1 or id(onward[0]) in used:
                raise _no_chain(bodies, urdf, steps, body, (base, platform), motors, within)
            connection = onward[0]
        paths.append(steps)
    stray = [c for c in bodies.connections if id(c) not in used]
    if stray:
        raise OutOfClass(
            "this is not a platform on legs",
            f"{_name(stray[0])} on no chain from base to platform",
            "every joint on a leg",
            "fix it or remove it",
            urdf.path,
        )
    return paths


def propose_block(source: Source, motors: Sequence[str] | None) -> LegcalBlock:
    """Return the default block ``legcal`` for a file without one.

    Without *motors* all revolute joints on the base may be motors of arms.
    """
    urdf, bodies = source.urdf, rigid_bodies(source.urdf, source.closures, None)
    root, problems = bodies.body_of[urdf.root], list[OutOfClass]()
    blocks = dict[str, LegcalBlock]()
    bases = [root, *_joined_bodies(bodies, urdf, root)]
    if source.base is not None:
        bases = [bodies.body_of[source.base]]
    for base in bases:
        try:
            blocks[base] = _block_on(
                base, source, motors_on(bodies, base) if motors is None else motors
            )
        except OutOfClass as error:
            problems.append(error)
        if root in blocks:
            return blocks[root]
    if len(blocks) > 1:
        pairs = " or ".join(f"'{b.base}' (platform '{b.platform}')" for b in blocks.values())
        raise OutOfClass(
            "no base could be proposed",
            f"legs between several pairs of links, with the base {pairs}",
            "one",
            urdf.wording.state_ends,
            source.path,
        )
    if not blocks:
        raise problems[0]
    return next(iter(blocks.values()))


def _joined_bodies(bodies: Bodies, urdf: Urdf, root: str) -> list[str]:
    """Return the bodies other than the root on which several chains end, in the file's order."""
    ends = [body for c in bodies.connections if not c.is_virtual for body in c.bodies]
    order = dict.fromkeys(bodies.body_of[link] for link in urdf.links)
    return [body for body in order if body != root and ends.count(body) > 2]


def motors_on(bodies: Bodies, base: str) -> list[str]:
    """Return the joints on a body that could be motors of arms, for a file that names none."""
    return [
        c.joint
        for c in bodies.connections
        if c.joint is not None and base in c.bodies and c.type == "revolute"
    ]


def _block_on(base: str, source: Source, motors: Sequence[str]) -> LegcalBlock:
    """Return the default block ``legcal`` with a body as the base."""
    urdf, closures = source.urdf, source.closures
    bodies = rigid_bodies(urdf, closures, None)
    root, base_link = bodies.body_of[urdf.root], source.base or urdf.root
    if source.base is None and (base != root or not _is_used(urdf, closures, urdf.root)):
        base_link = _main_link(urdf, closures, bodies, base)
    if source.platform is None:
        platform = _platform_body(bodies, base, base_link, source, motors)
    else:
        platform = bodies.body_of[source.platform]
    carrier = next(
        (c for c in bodies.connections if c.is_virtual and {*c.bodies} == {base, platform}), None
    )
    joint = None if carrier is None else carrier.joint
    link = source.platform or (
        _main_link(urdf, closures, bodies, platform) if joint is None else urdf.joints[joint].child
    )
    bodies = rigid_bodies(urdf, closures, joint)
    chains = in_order(find_chains(bodies, urdf, base_link, link, motors), motors, urdf)
    needed = n_frame_legs(spatial=plane_of_motion(chains) is None)
    if len(chains) < needed and base != root and source.base is None:
        raise OutOfClass(
            "this is not a platform on legs",
            f"{len(chains)} legs on link '{base_link}'",
            f"at least {needed}",
            urdf.wording.state_ends,
            source.path,
        )
    joints = [distinct_joint(chain) for chain in chains]
    return LegcalBlock(
        version=1,
        base=base_link,
        platform=link,
        platform_joint=joint,
        legs=dict(zip(_leg_names(joints), joints, strict=True)),
    )


def _is_used(urdf: Urdf, closures: Sequence[Closure], link: str) -> bool:
    """Return whether a moving joint or a closure is on a link itself."""
    ends = {urdf.link_of(frame) for c in closures for frame in c.frames}
    return link in ends or any(
        j.moves and link in (j.parent, j.child) for j in urdf.joints.values()
    )


def propose_frame(names: Sequence[str], chains: Sequence[LegChain]) -> list[str]:
    """Return the legs that define the frames: largest span of joints on base and platform."""
    normals = plane_of_motion(chains)
    count = n_frame_legs(spatial=normals is None)
    if len(names) <= count:
        return list(names)
    ends = (
        np.array([chain.A for chain in chains]),
        np.array([chain.B_platform for chain in chains]),
    )
    if normals is not None:
        ends = _flat(ends[0], normals[0]), _flat(ends[1], normals[1])
    chosen = list(combinations(range(len(names)), count))
    of_motors = [
        [chains[j].motor if chains[j].actuator is not None else names[j] for j in c] for c in chosen
    ]
    most = max(len(set(of_legs)) for of_legs in of_motors)  # one leg per actuator, if possible
    chosen = [c for c, m in zip(chosen, of_motors, strict=True) if len(set(m)) == most]
    spans = np.array([_span(ends[0][list(c)]) * _span(ends[1][list(c)]) for c in chosen])
    first = int(np.argmax(spans >= spans.max() * (1.0 - TIE)))
    return [names[j] for j in chosen[first]]


def level_rotation(A: Array, B: Array) -> Rotation:
    """Return the rotation of a platform with its joints B (n, 3) over those of the base A (n, 3).

    It aligns the directions of the joints from their mean in the least-squares sense (Kabsch 1976),
    independent of the link frames: the platform is level and not turned.
    """
    with warnings.catch_warnings():  # where several rotations are the best, any will do
        warnings.simplefilter("ignore", UserWarning)
        return Rotation.align_vectors(A - A.mean(axis=0), B - B.mean(axis=0))[0]


def in_order(chains: Sequence[LegChain], motors: Sequence[str], urdf: Urdf) -> list[LegChain]:
    """Return legs in the order of their motors, then the others in the order of the URDF."""
    rank = {name: i for i, name in enumerate([*urdf.joints, *motors])}
    rank |= {name: i - len(motors) for i, name in enumerate(motors)}
    return sorted(chains, key=lambda chain: rank[any_joint(chain)])


def distinct_joint(chain: LegChain) -> str:
    """Return a joint that identifies a single leg: on an actuator not the motor."""
    if chain.actuator is None:
        return any_joint(chain)
    named = [s.joint for s in chain.steps[1:] if s.joint]
    return named[0] if named else any_joint(chain)


def any_joint(chain: LegChain) -> str:
    """Return a joint that identifies a leg: its slider, or its first joint."""
    named = [s.joint for s in chain.steps if s.joint]
    return chain.motor or (named[0] if named else "")


def plane_of_motion(chains: Sequence[LegChain]) -> Normals | None:
    """Return the normal of the plane in which a mechanism moves, None if it moves in space.

    All joints must be revolutes with parallel axes; sliders of supported legs are perpendicular to
    them.
    """
    normals = [_normals(chain) for chain in chains]
    first = normals[0]
    if first is None:
        return None
    for other in normals:
        if other is None or not all(parallel(a, b) for a, b in zip(first, other, strict=True)):
            return None
    return first


def normals_in_links(normals: Normals, T_body_link: tuple[Array, Array]) -> Normals:
    """Return the normals in the links of base and platform.

    The last nonzero component is positive in the base.
    """
    base, platform = (T[:3, :3].T @ normal for normal, T in zip(normals, T_body_link, strict=True))
    return (base, platform) if np.all(undirected(base) == base) else (-base, -platform)


def normals_of_closures(
    in_link_frames: Normals | None, closures: Sequence[Closure], block: LegcalBlock, urdf: Urdf
) -> list[Array | None]:
    """Return the normals of closures that need to hold in the plane only, None for others.

    Closures of a planar mechanism all imply that it is planar, and contradict each other by the
    rounding of its axes. So all hold in the plane only, except one if a floating joint carries the
    platform, to keep it in the plane.
    """
    if in_link_frames is None:
        return [None] * len(closures)
    virtual = None if block.platform_joint is None else urdf.joints[block.platform_joint]
    floats = virtual is not None and virtual.type == "floating"
    normals: list[Array | None] = []
    for closure in closures:
        link = urdf.link_of(closure.frames[0])
        root, normal = (block.base, in_link_frames[0])
        if floats and virtual in urdf.joints_above(link):
            root, normal = (block.platform, in_link_frames[1])
        turn = urdf.poses[link].rotation.inv() * urdf.poses[root].rotation
        normals.append(np.asarray(turn.apply(normal)) if closure.kind == "6d" else None)
    return [None, *normals[1:]] if floats else normals


def check_virtual_joint(
    block: LegcalBlock, bodies: Bodies, urdf: Urdf, normals: Normals | None, path: Path
) -> None:
    """Check the virtual joint, if any: it carries the platform from the base as the legs let it.

    Raises OutOfClass if it is neither floating nor planar, connects other bodies, or moves in
    another plane than the legs.
    """
    if block.platform_joint is None:
        return
    joint = urdf.joints[block.platform_joint]
    carrying = bodies.body_of[joint.parent], bodies.body_of[joint.child]
    z = joint.T_parent_origin.rotation.apply([0.0, 0.0, 1.0])
    if joint.type not in VIRTUAL:
        problem = (
            f"a {joint.type} joint",
            "a floating or planar one, which only says where the platform is",
            "correct it, or write null if a leg carries the platform",
        )
    elif carrying != (bodies.body_of[block.base], bodies.body_of[block.platform]):
        problem = (
            f"it between the parent '{joint.parent}' and the child '{joint.child}'",
            f"'{block.base}' and '{block.platform}'",
            "name the joint that carries the platform, or write null",
        )
    elif joint.type == "floating":
        return
    elif not np.array_equal(joint.axis, [0.0, 0.0, 1.0]):
        axis = ", ".join(f"{x:g}" for x in joint.axis)
        problem = (
            f"a planar joint with the axis ({axis})",
            '<axis xyz="0 0 1"/>, because its plane is the xy plane of its frame',
            "turn its origin rpy instead",
        )
    elif normals is None:
        problem = (
            "a planar joint",
            "a floating one, because the axes of the legs do not let the platform move in one "
            "plane",
            "correct its type",
        )
    elif not parallel(z, normal := bodies.T_body_link[joint.parent][:3, :3].T @ normals[0]):
        tilt = 90.0 - np.degrees(off_square(z, normal))
        problem = (
            f"its plane {tilt:.4g} deg from the plane in which the legs move",
            "the same plane within 0.057 deg",
            "correct its origin rpy",
        )
    else:
        return
    start = f"legcal.platform_joint '{joint.name}' is not supported"
    raise OutOfClass(start, *problem, path)


def _refuse_unsupported(connection: Connection, urdf: Urdf, base: str, platform: str) -> None:
    """Refuse joints that are not part of any leg."""
    if connection.is_virtual:
        problem = (
            f"the {connection.type} joint '{connection.joint}' inside it",
            "at most the virtual one that carries the platform",
            "name that one in legcal.platform_joint",
        )
    elif connection.bodies[0] == connection.bodies[1]:
        problem = (
            f"{_name(connection)} between two links that are rigidly connected",
            "a joint that can move",
            "remove it",
        )
    elif set(connection.bodies) == {base, platform} and connection.type == "prismatic":
        problem = (
            f"{_name(connection)} directly between base and platform",
            "legs",
            "name it in legcal.platform_joint if it is the virtual joint that carries the platform",
        )
    else:
        return
    raise OutOfClass("this mechanism is not supported", *problem, urdf.path)


def _no_chain(
    bodies: Bodies,
    urdf: Urdf,
    steps: list[Connection],
    body: str,
    ends: tuple[str, str],
    motors: Sequence[str],
    within: float,
) -> OutOfClass:
    """Return the refusal of a leg that is no chain, given by its joints to the *body* in question.

    From a body without passing base or platform, a loop inside a leg leads to the base by one
    joint, a part of a platform of several bodies by the joints of several legs.
    """
    first, last = _name(steps[0]), _name(steps[-1])
    n_onward = sum(body in c.bodies for c in bodies.connections) - 1
    needed = "one unbranched chain from base to platform for each leg"
    remedy = f"check {urdf.wording.closures}, or {urdf.wording.correct_ends}"
    inside = [c.bodies for c in bodies.connections if {*c.bodies}.isdisjoint(ends)]
    group = connected([name for c in bodies.connections for name in c.bodies], inside)[body]
    on_base, on_platform = (
        [c for c in bodies.connections if end in c.bodies and not group.isdisjoint(c.bodies)]
        for end in ends
    )
    is_arm = _is_an_arm(steps, within)
    driven = steps[-1].joint in motors or (steps[0].joint in motors and is_arm)
    if body == ends[0]:
        found = f"a chain that starts with {first} and returns to the base"
    elif n_onward == 0:
        found = f"a chain from {first} that ends at link '{body}' without reaching the platform"
    elif n_onward > 1 and not is_arm and len(on_platform) == len(on_base) == 1:
        found = f"a loop inside the leg that starts with {first}, closed at link '{body}'"
        remedy = (
            "if these are the rods of a parallelogram on an arm or a carriage, close each on the "
            f"platform as a leg of its own, otherwise {NOT_CALIBRATED}"
        )
    elif n_onward > 1 and not is_arm and len(on_platform) == 1:
        joint = _name(on_platform[0])
        found = (
            "a platform of several bodies (as of an H4 or I4), because legs end on link "
            f"'{body}', which {joint} connects to the platform"
        )
        needed = "legs that end on one rigid platform"
        remedy = f"make {joint} fixed if it does not move, otherwise {NOT_CALIBRATED}"
    elif n_onward > 1 and len(steps) > 1 and driven:
        found = (
            f"a chain from {first} with {n_onward} rods on link '{body}', which {last} connects "
            "to the moving link before it"
        )
        needed = "rods on the link that one motor on the base moves"
        remedy = f"make joints of this leg fixed that do not move, otherwise {NOT_CALIBRATED}"
    elif n_onward > 1 and is_arm:
        found = (
            f"a chain that starts with {first} and carries {n_onward} rods on the moving link "
            f"'{body}', so that the joints at A move"
        )
        needed = (
            "joints whose centres are fixed in the base, or a motor in name_mot that moves this "
            "link itself"
        )
        remedy = f"name {first} in name_mot if a motor turns it, otherwise {remedy}"
    else:
        found = f"a chain from {first} that shares link '{body}' with another leg or branches there"
    return OutOfClass("this is not a platform on separate legs", found, needed, remedy, urdf.path)


def _is_an_arm(steps: list[Connection], within: float) -> bool:
    """Return whether joints form an arm whose end moves: one revolute, or several apart."""
    if any(step.type != "revolute" for step in steps):
        return False
    return len(steps) == 1 or any(
        Axis(lower.name, *lower.line(1)).gap(Axis(upper.name, *upper.line(0))) > within
        for lower, upper in pairwise(steps)
    )


def _name(connection: Connection) -> str:
    """Return a joint or closure in words."""
    if connection.joint is not None:
        return f"joint '{connection.joint}'"
    return f"the 3d closure number {(connection.closure or 0) + 1}"


def _normals(chain: LegChain) -> Normals | None:
    """Return the direction of all axes of a leg in base and platform, None if they differ."""
    if chain.base.type.n_freedoms != 1 or chain.platform.type.n_freedoms > 1:
        return None
    v, w = chain.base.inner, chain.platform.inner
    if v is None or (w is not None and not parallel(v, w)):
        return None
    return v, chain.poses[-1][:3, :3].T @ v


def _platform_body(
    bodies: Bodies, base: str, base_link: str, source: Source, motors: Sequence[str]
) -> str:
    """Return the body where the legs end: every chain from the base to it is a supported leg."""
    urdf, path, at = source.urdf, source.path, dict[str, list[str]]()
    carried = {c.bodies[1] for c in bodies.connections if c.is_virtual}
    bodies = replace(bodies, connections=tuple(c for c in bodies.connections if not c.is_virtual))
    for connection in bodies.connections:
        for here, there in (connection.bodies, connection.bodies[::-1]):
            at.setdefault(here, []).append(there)
    n_base = len(at.get(base, []))
    if n_base < 2:
        joints = "1 joint" if n_base == 1 else "no joint"
        raise OutOfClass(
            "this is not a parallel mechanism",
            f"{joints} on the base ({urdf.wording.root})",
            "one for each leg",
            f"{urdf.wording.state_ends} if another link is the base",
            path,
        )
    meeting = [body for body in at if body != base and len(at[body]) > 2]
    candidates = meeting or [body for body in at if body != base]
    candidates = [body for body in candidates if body in carried] or candidates
    candidates.sort(key=lambda body: (base in at[body], -len(at[body])))  # arms come last
    platforms, reasons = [], list[OutOfClass]()
    for body in candidates:
        try:
            find_chains(bodies, urdf, base_link, body, motors)
        except OutOfClass as error:
            reasons.append(error)
        else:
            platforms.append(body)
    if len(platforms) == 1:
        return platforms[0]
    if platforms:
        raise OutOfClass(
            "no platform could be proposed",
            f"several links where legs could end ({', '.join(platforms)})",
            "one",
            urdf.wording.state_ends,
            path,
        )
    if meeting:
        raise reasons[0]
    raise OutOfClass(
        "this mechanism is not supported",
        "one closed chain in which no link is a platform on legs, because on "
        "each side of any link more than a slider or a rod moves the joint at A",
        "legs of type joint, slider or rod, joint",
        NOT_CALIBRATED,
        path,
    )


def _main_link(urdf: Urdf, closures: Sequence[Closure], bodies: Bodies, body: str) -> str:
    """Return the link of a body with the most children and closures."""
    links = [link for link in urdf.links if bodies.body_of[link] == body]
    uses = dict.fromkeys(links, 0)
    for joint in urdf.joints.values():
        if joint.parent in uses:
            uses[joint.parent] += 1
    for closure in closures:
        for frame in closure.frames:
            if urdf.link_of(frame) in uses:
                uses[urdf.link_of(frame)] += 1
    return max(links, key=lambda link: uses[link])


def _leg_names(joints: Sequence[str]) -> list[str]:
    """Return leg names from the names of their joints, if these are distinct."""
    fronts = [joint.split("_")[0] for joint in joints]
    if len(set(fronts)) == len(fronts) and all(map(is_plain_name, fronts)):
        return fronts
    return [f"leg{j + 1}" for j in range(len(joints))]


def _flat(points: Array, normal: Array) -> Array:
    """Return points projected along a normal."""
    return np.asarray(points - (points @ normal)[:, None] * normal)


def _span(points: Array) -> float:
    """Return the distance of two points [m], or twice the area of a triangle [m^2]."""
    if len(points) == 2:
        return float(np.linalg.norm(points[1] - points[0]))
    return float(np.linalg.norm(cross(points[1] - points[0], points[2] - points[0])))
