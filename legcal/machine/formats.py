"""Reading a mechanism of any format: detecting the format and calling its reader.

A YAML with its URDF (ours, or Gepetto's, with stand-in joints), a URDF with its own loops, or MJCF
(:mod:`legcal.machine.mjcf`): all are converted to a :class:`Source`, a tree with pairs of
coincident frames.

CAD exports contain the whole machine: a head turns on its base, a hand or an antenna moves on the
platform, a robot floats in its world. A joint on no path of the tree between the two frames of a
closure does not move the loops; it is held where it is drawn, so that only the mechanism moves.
Without a block ``legcal`` the loops are closed near the drawn configuration, and sliders without
limits get a travel.
"""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from lxml import etree
from scipy.linalg import null_space
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.errors import ModelError, OutOfClass, Problems, UsageError
from legcal.files.schema import closest, content_of
from legcal.geometry.types import Array
from legcal.machine.chain import ClosedChain, Closure, rigid_bodies
from legcal.machine.files import (
    FILE_KIND,
    MechanismFile,
    find_model,
    find_urdf,
    is_xml,
    read_mechanism_file,
    yaml_of_urdf,
)
from legcal.machine.solver import Equations, solve
from legcal.machine.spanning_tree import (
    Source,
    UrdfBuilder,
    check_one_mechanism,
    closing_frames,
    moving_groups,
    origin_xml,
    parts_of,
    read_loop_source,
)
from legcal.machine.topology import find_chains, level_rotation, motors_on, propose_block
from legcal.machine.urdf import (
    LOOP_TAGS,
    NO_BLOCK,
    URDF_LOOPS,
    Urdf,
    UrdfJoint,
    parse_urdf,
    parse_xml,
    read_urdf,
)

_UNIVERSAL = re.compile(r"UJOINT_([XYZ])([XYZ])")
_AXES = dict(zip("XYZ", np.eye(3), strict=True))


def read_source(model: str | Path, base: str | None = None, platform: str | None = None) -> Source:
    """Return the tree and the closures of a mechanism; each file is checked in itself.

    The links *base* and *platform* are stated for a file without a block ``legcal``.
    """
    path = find_model(model)
    source = _read_xml(path) if is_xml(path) else read_yaml_source(path)
    _check_stated(source, base, platform)
    names = {*source.urdf.links, *source.urdf.joints}
    if not all(len(names & {*closure.frames}) == 2 for closure in source.closures):
        return source  # refused later, with the location of the name
    source = with_held_joints(source)
    if source.block is not None:
        check_one_mechanism(source)
        is_drawn = source.block.home is None and is_drawn_closed(source)
        return completed(source) if is_drawn else source
    source = replace(source, base=base, platform=platform)
    if base is not None or platform is not None:
        source = with_held_joints(_of_stated(source))
    check_one_mechanism(source)
    if source.urdf.wording is URDF_LOOPS and not source.motors:
        source = _with_arms_as_motors(source)
    return completed(source)


def _check_stated(source: Source, base: str | None, platform: str | None) -> None:
    """Refuse links stated for a file that names others itself, or has no such link."""
    problems = Problems(source.path)
    for option, link in (("--base", base), ("--platform", platform)):
        if link is not None and source.block is not None:
            problems.add(
                f"{option} could not be used",
                "a file with a block legcal, which names base and platform",
                "a file without it",
                f"write '{link}' in legcal.{option.removeprefix('--')}",
            )
        elif link is not None and link not in source.urdf.links:
            absent = f"the link '{link}', which is not in the file"
            remedy = closest(link, source.urdf.links)
            problems.add(f"{option} could not be used", absent, remedy=remedy)
    problems.raise_if_any(UsageError)


def _of_stated(source: Source) -> Source:
    """Return a file with the loops of that mechanism alone whose platform or base is stated."""
    groups = moving_groups(source.urdf, source.closures)
    stated = {source.base, source.platform}
    mine = {link for links, _ in groups if stated & {*links} for link in links}
    kept = tuple(c for c in source.closures if mine & {*map(source.urdf.link_of, c.frames)})
    return replace(source, closures=kept or source.closures)


def _with_arms_as_motors(source: Source) -> Source:
    """Return a mechanism without motors with those joints on its base as motors that move rods."""
    urdf, closures = source.urdf, source.closures
    with suppress(OutOfClass):
        propose_block(source, [])
        return source  # moved by hand
    with suppress(OutOfClass):
        block = propose_block(source, None)
        bodies = rigid_bodies(urdf, closures, block.platform_joint)
        turning = motors_on(bodies, bodies.body_of[block.base])
        chains = find_chains(bodies, urdf, block.base, block.platform, turning)
        moving = {chain.motor for chain in chains}
        motors = tuple(name for name in turning if name in moving)
        note = (
            f"The file names no motors: the {len(motors)} joints on the base that move rods "
            f"({', '.join(motors)}) were taken as motors; name the motors in <transmission> "
            "elements if some are not."
        )
        return replace(source, motors=motors, notes=(*source.notes, note))
    return source


def _read_xml(path: Path) -> Source:
    """Return the mechanism of an XML file, by its root element."""
    beside = yaml_of_urdf(path)
    if beside is not None and path.suffix.lower() != ".mjcf":
        return read_yaml_source(beside)
    content = content_of(path, FILE_KIND, ModelError)
    root = parse_xml(path, content, "mechanism file")
    if root.tag == "mujoco":
        from legcal.machine.mjcf import read_mjcf_source

        return read_mjcf_source(path, content)
    if root.tag != "robot":
        sdf = "an SDF file of Gazebo"
        problems = Problems(path)
        problems.add(
            "the mechanism could not be read",
            sdf if root.tag == "sdf" else f"<{root.tag}> as the root element",
            "<robot> (URDF) or <mujoco> (MJCF)",
            "export the model as one of them",
            cast("int", root.sourceline),
        )
        problems.raise_if_any()
    if any(element.tag in LOOP_TAGS for element in root) or closing_frames(root, path):
        return read_loop_source(path, content)
    parse_urdf(path, content, travel_needed=False)  # a link with two parents closes a loop as well
    raise OutOfClass(
        "this is not a parallel mechanism",
        "a URDF, which is a tree without closed loops, and no YAML that closes them",
        "",
        f"write {path.with_suffix('.yaml')} with closed_loop, type, name_mot and a legcal block",
        path,
    )


def read_yaml_source(path: Path) -> Source:
    """Return a mechanism from its YAML and the URDF named there.

    A file without the block ``legcal`` may leave the travel of sliders open, as Gepetto's do.
    """
    file = read_mechanism_file(path)
    block = file.legcal
    urdf = read_urdf(
        find_urdf(path, None if block is None else block.urdf), travel_needed=block is not None
    )
    if block is None:
        urdf = replace(urdf, wording=NO_BLOCK)
    source = Source(path, urdf, file.closures, tuple(file.name_mot), block)
    check_stand_ins(file, urdf, path)
    if not file.joint_name:
        return source
    robot = urdf.robot()
    frames = replace_stand_ins(robot, file, urdf)
    on_replaced = [joint for joint in (block.legs.values() if block else ()) if joint in frames]
    if on_replaced:
        raise ModelError(
            "legcal.legs could not be used",
            f"'{on_replaced[0]}', which stands for another joint (joint_name)",
            "another joint of that leg",
            "name its prismatic joint",
            path,
        )
    closures = tuple(
        Closure(closure.kind, (frames.get(first, first), frames.get(second, second)))
        for closure in file.closures
        for first, second in [closure.frames]
    )
    urdf = urdf.edited(robot, travel_needed=block is not None)
    return replace(source, urdf=urdf, closures=closures)


def check_stand_ins(file: MechanismFile, urdf: Urdf, path: Path) -> None:
    """Check that each stand-in joint occurs once and has a known type."""
    problems = Problems(path)
    for i, (name, kind) in enumerate(zip(file.joint_name, file.joint_type, strict=True)):
        refused = f"joint_name.{i} could not be used"
        if name not in urdf.joints:
            absent = f"the joint '{name}', which is not in {urdf.path.name}"
            problems.add(refused, absent, remedy=closest(name, sorted(urdf.joints)))
        elif file.joint_name.index(name) != i:
            problems.add(refused, f"'{name}' twice", "each joint once", "remove one")
        elif name in file.name_mot and kind != "FIXED":
            stand_in = f"'{name}', which stands for {kind} (joint_name.{i})"
            refused = "name_mot could not be used"
            problems.add(refused, stand_in, "a joint with one reading", "remove it")
        if rotation_letters(kind) is None:
            needed = "SPHERICAL, FIXED, or UJOINT_ and two different letters of X, Y, Z"
            problems.add(f"joint_type.{i} could not be used", f"'{kind}'", needed, "correct it")
    problems.raise_if_any()


def rotation_letters(kind: str) -> str | None:
    """Return the rotation axes of a joint type as letters, in order; None if unknown."""
    if kind in ("SPHERICAL", "FIXED"):
        return "XYZ" if kind == "SPHERICAL" else ""
    match = _UNIVERSAL.fullmatch(kind)
    return match[1] + match[2] if match and match[1] != match[2] else None


def replace_stand_ins(robot: etree._Element, file: MechanismFile, urdf: Urdf) -> dict[str, str]:
    """Replace the stand-in joints of a URDF; return the frames that they carried."""
    elements = {e.get("name"): e for e in robot if e.tag == "joint"}
    replaced, taken = {}, {*urdf.links, *urdf.joints}
    for name, kind in zip(file.joint_name, file.joint_type, strict=True):
        element, joint = elements[name], urdf.joints[name]
        if kind == "FIXED":
            element.set("type", "fixed")
            continue
        replaced[name] = joint.child
        axes = {letter: _AXES[letter] for letter in str(rotation_letters(kind))}
        text = UrdfBuilder(taken=taken)
        text.turns(name, joint.parent, joint.child, joint.T_parent_origin, axes)
        at = robot.index(element)
        robot[at : at + 1] = text.elements()
        taken |= text.links.keys() | text.joints.keys()
    return replaced


TRIALS = 24
STEPS = 200
CLOSED = 1e-10  # largest residual of a closed loop [m, rad]
TRAVEL_OF_SIZE = 0.05  # assumed travel of sliders to either side, relative to the machine
_DRAWN_CLOSED = 1e-4  # gap of drawn loops, relative to the machine, that is rounding
_OPEN = 0.01  # gap of drawn loops, relative to the machine, above which they define no home
_RIGID = 1e-3  # tolerance of determinants of rotations
_SPREAD = 0.1  # start offset of a trial per trial number [rad], and relative to the machine
_MAX_STEP = 0.3  # largest step [rad], and relative to the machine
_SHOWN = 6  # joints named in a note


def with_held_joints(source: Source) -> Source:
    """Return a mechanism whose joints outside all loops are fixed at their drawn values.

    A chain with a motor and a passive joint that ends in the air is refused: a leg left open.
    """
    urdf, motors = source.urdf, source.motors
    held = open_joints(urdf, source.closures)
    if source.block is not None:
        held.pop(source.block.platform_joint or "", None)
    if not held:
        return source
    _refuse_open_leg(urdf, held, motors, source)
    shown = ", ".join(f"'{name}'" for name in list(held)[:_SHOWN])
    shown += f" and {len(held) - _SHOWN} more" * (len(held) > _SHOWN)
    note = f"the joints {shown} close no loop and are held as drawn."
    if len(held) == 1:
        note = f"the joint {shown} closes no loop and is held as drawn."
    robot = urdf.robot()
    for element in robot.findall("joint"):
        joint = held.get(element.get("name", ""))
        if joint is None:
            continue
        for tag in ("origin", "mimic", "limit", "axis"):
            for part in element.findall(tag):
                element.remove(part)
        element.set("type", "fixed")
        T = joint.T_parent_origin * _motion(joint, source.values.get(joint.name, 0.0))
        element.append(etree.fromstring(origin_xml(*parts_of(T))))
    return replace(
        source,
        motors=tuple(motor for motor in motors if motor not in held),
        # The travel of sliders was asked for, or not, when the file was read.
        urdf=urdf.edited(robot),
        notes=(*source.notes, note),
        values={name: value for name, value in source.values.items() if name not in held},
    )


def open_joints(urdf: Urdf, closures: Iterable[Closure]) -> dict[str, UrdfJoint]:
    """Return the joints that can move and are in no loop, by name."""
    in_loops = set[str]()
    for closure in closures:
        first, second = (
            {joint.name for joint in urdf.joints_above(urdf.link_of(frame))}
            for frame in closure.frames
        )
        in_loops |= first ^ second
    return {
        name: joint for name, joint in urdf.joints.items() if joint.moves and name not in in_loops
    }


def _motion(joint: UrdfJoint, value: float) -> RigidTransform:
    """Return the motion of a joint at a value [m or rad], none for a floating or planar one."""
    if joint.type == "prismatic":
        return RigidTransform.from_translation(value * joint.axis)
    if joint.type in ("revolute", "continuous"):
        return RigidTransform.from_rotation(Rotation.from_rotvec(value * joint.axis))
    return RigidTransform.identity()


def _refuse_open_leg(
    urdf: Urdf, held: Mapping[str, UrdfJoint], motors: Sequence[str], source: Source
) -> None:
    """Refuse a chain with a motor and a passive joint that ends without closing a loop."""
    for joint in held.values():
        branch = [j for j in urdf.joints_below(joint) if j.moves]
        if any(j.name not in held for j in branch):
            continue  # it carries the mechanism
        driven = [j.name for j in branch if j.name in motors]
        passive = [j.name for j in branch if j.name not in motors]
        if driven and passive:
            raise OutOfClass(
                "this is not a platform on separate legs",
                f"the motor '{driven[0]}' of a leg that starts with joint '{joint.name}', "
                "on no chain from base to platform",
                "a closed loop for each leg",
                f"add the missing pair to {urdf.wording.closures}, or make joint "
                f"'{passive[0]}' fixed if the chain is no leg",
                source.path,
            )


def completed(source: Source) -> Source:
    """Return a mechanism without a block, completed with the closed poses and all travels."""
    chain = ClosedChain.of(source.urdf, source.closures)
    start = chain.neutral()
    for joint, value in source.values.items():
        start[chain.q_index(joint)] = value
    drawn_at = [chain.pose(start, source.urdf.root, link).translation for link in source.urdf.links]
    unit = chain.column_units(float(np.ptp(drawn_at, axis=0).max()) or 1.0)
    closed = closed_near(chain, start, source.urdf.links, unit)
    configuration = start if closed is None else closed
    urdf = source.urdf
    sliders = [
        joint.name
        for joint in urdf.joints.values()
        if joint.type == "prismatic" and joint.limits is None
    ]
    off = _loop_error(chain, start)
    if sliders and closed is not None and off > CLOSED:
        configuration = closed = _levelled(chain, closed, source, unit)
    elif closed is not None and off > CLOSED:
        configuration = closed = _at_drawn_motors(chain, closed, start, source, unit)
    poses = {link: chain.pose(configuration, urdf.root, link) for link in urdf.links}
    size = float(np.ptp([pose.translation for pose in poses.values()], axis=0).max())
    if sliders:
        readings = {name: float(configuration[chain.q_index(name)]) for name in sliders}
        source = _with_travel(source, readings, size)
    if closed is None:
        return source
    drawn = {
        name: float(configuration[chain.q_index(name)])
        for name in source.motors
        if name in urdf.joints and urdf.joints[name].type in ("prismatic", "revolute")
    }
    is_open = not sliders and off > _OPEN * size
    return replace(source, poses=poses, drawn=drawn, is_drawn_open=is_open)


def _at_drawn_motors(
    chain: ClosedChain, closed: Array, start: Array, source: Source, unit: Array
) -> Array:
    """Return a closed configuration with the motors where the file draws them, if there is one."""
    moved = [source.urdf.joints[name].type in ("prismatic", "revolute")
             for name in source.motors if name in source.urdf.joints]  # fmt: skip
    if len(moved) < len(source.motors) or not all(moved):
        return closed
    values = [chain.q_index(name) for name in source.motors]
    rates = np.zeros((len(values), chain.nv))
    rates[range(len(values)), [chain.v_index(name) for name in source.motors]] = 1.0

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        off = points[0][values] - start[values]
        return np.concatenate([residual, off])[None], np.concatenate([jacobian, rates])[None]

    there = _solved(chain, equations, closed, unit)
    return closed if there is None else there


def _levelled(chain: ClosedChain, configuration: Array, source: Source, unit: Array) -> Array:
    """Return a closed configuration with a level platform, or the given one if there is none.

    A file without a closed drawing and without slider limits leaves the pose undetermined. Among
    the level poses the one with sliders nearest to their drawn positions is taken.
    """
    urdf = source.urdf
    try:
        block = propose_block(source, source.motors)
    except OutOfClass:
        return configuration  # refused later
    bodies = rigid_bodies(urdf, source.closures, block.platform_joint)
    motors = source.motors
    chains = find_chains(bodies, urdf, block.base, block.platform, motors)
    A, B = (
        np.array(points) @ bodies.T_body_link[link][:3, :3]
        for link, points in (
            (block.base, [leg.A for leg in chains]),
            (block.platform, [leg.B_platform for leg in chains]),
        )
    )
    level = RigidTransform.from_rotation(level_rotation(A, B))

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        turned, by_joints = chain.welded(block.base, block.platform, level)
        rows = np.concatenate([residual, turned[3:]]), np.concatenate([jacobian, by_joints[3:]])
        return rows[0][None], rows[1][None]

    closed = _solved(chain, equations, configuration, unit)
    if closed is None:
        return configuration
    sliders = [name for name, joint in urdf.joints.items() if joint.type == "prismatic"]
    values = [chain.q_index(name) for name in sliders]
    rates = [chain.v_index(name) for name in sliders]
    for _ in range(STEPS):
        free = null_space(equations(closed[None])[1][0], rcond=1e-9)
        step = -free @ np.linalg.lstsq(free[rates], closed[values], rcond=1e-6)[0]
        nearer = _solved(chain, equations, chain.integrate(closed, _shortened(step, unit)), unit)
        if nearer is None or np.linalg.norm(nearer[values]) >= np.linalg.norm(closed[values]):
            break
        closed = nearer
    return closed


def closed_near(
    chain: ClosedChain, start: Array, links: Sequence[str], unit: Array
) -> Array | None:
    """Return a closed configuration near a given one, or None.

    Of the results of several starts, the one with the smallest rotations of links is taken. *unit*
    (nv,) is the size of the machine [m], 1 for angles.
    """
    if _loop_error(chain, start) <= CLOSED:
        return start
    rng = np.random.default_rng(1965)
    best: tuple[float, Array] | None = None
    drawn = chain.turns(start, links[0], links)

    def equations(points: Array) -> tuple[Array, Array]:
        residual, jacobian = chain.linearize(points[0])
        return residual[None], jacobian[None]

    for trial in range(TRIALS):
        away = chain.integrate(start, _SPREAD * trial * unit * rng.normal(size=chain.nv))
        closed = _solved(chain, equations, away, unit)
        if closed is None:
            continue
        turned = _turned(drawn, chain.turns(closed, links[0], links))
        if best is None or turned < best[0] - 1e-6:
            best = turned, closed
    return None if best is None else best[1]


def _turned(before: Array, after: Array) -> float:
    """Return the total difference of rotations (n, 3, 3) [rad]."""
    apart = np.swapaxes(before, 1, 2) @ after
    if not np.all(np.abs(np.linalg.det(apart) - 1.0) < _RIGID):  # degenerate or not finite
        return math.inf
    return float(Rotation.from_matrix(apart).magnitude().sum())


def _shortened(step: Array, unit: Array) -> Array:
    """Return a step (nv,), shortened to ``_MAX_STEP``."""
    longest = float(np.abs(step / unit).max(initial=0.0))
    return np.asarray(step * min(1.0, _MAX_STEP / max(longest, 1e-300)))


def _solved(
    chain: ClosedChain, equations: Equations, configuration: Array, unit: Array
) -> Array | None:
    """Return the solution of equations near a configuration, or None."""
    solution = solve(
        equations,
        lambda points, step: chain.integrate(points[0], _shortened(step[0], unit))[None],
        configuration[None],
        tolerance=CLOSED,
        unit=unit,
        damped=True,
        steps=STEPS,
    )
    return solution.points[0] if solution.worst[0] <= CLOSED else None


def is_drawn_closed(source: Source) -> bool:
    """Return whether the loops of a file are closed with all joints at zero, but for rounding."""
    chain = ClosedChain.of(source.urdf, source.closures)
    poses = source.urdf.poses.values()
    size = float(np.ptp([pose.translation for pose in poses], axis=0).max())
    return _loop_error(chain, chain.neutral()) <= _DRAWN_CLOSED * size


def _loop_error(chain: ClosedChain, configuration: Array) -> float:
    """Return the largest residual of the loops."""
    residual = chain.residual(configuration)
    return float(np.abs(residual).max()) if len(residual) else 0.0


def _with_travel(source: Source, readings: Mapping[str, float], size: float) -> Source:
    """Return a mechanism of a size [m] with an assumed travel of sliders about readings [m]."""
    reach = float(f"{TRAVEL_OF_SIZE * size:.0e}") if size > 0.0 else TRAVEL_OF_SIZE
    robot = source.urdf.robot()
    for element in robot.findall("joint"):
        name = str(element.get("name"))
        if name in readings:
            limit = element.find("limit")
            if limit is None:
                limit = etree.SubElement(element, "limit")
            limit.set("lower", repr(readings[name] - reach))
            limit.set("upper", repr(readings[name] + reach))
            for key in ("effort", "velocity"):
                limit.set(key, limit.get(key, "1000"))
    names = ", ".join(f"'{name}'" for name in list(readings)[:_SHOWN])
    note = (
        f"The file gives no travel for {len(readings)} sliders ({names}): {reach:g} m to either "
        "side of the closed pose was assumed; add their limits."
    )
    urdf = source.urdf.edited(robot, travel_needed=True)
    return replace(source, urdf=urdf, notes=(*source.notes, note))
