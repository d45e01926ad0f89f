"""Loading a mechanism: files, tree, closures, legs and home, each checked before the next.

A :class:`Source` is a URDF with a mechanism YAML that states the closures (other formats are
converted). The links are grouped into rigid bodies, chains of joints between base and platform are
classified as legs, and a closed pose is found; every check below names the mistake in the file.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import (
    BadValue,
    DidNotConverge,
    ModelError,
    OutOfClass,
    Problems,
    UsageError,
)
from legcal.files.motions import MotionEntry, motion_to_xyz_quat
from legcal.files.quantity import SHOWN_IN
from legcal.files.schema import closest, nearest
from legcal.geometry.types import Array
from legcal.machine.actuator import Actuator, Pulses
from legcal.machine.chain import Bodies, ClosedChain, rigid_bodies
from legcal.machine.classification import (
    NOT_CALIBRATED,
    actuator_of,
    joint_tolerance,
    leg_of,
    parallel,
)
from legcal.machine.closing import (
    CONFIGURATIONS,
    MAX_POSE_ERROR,
    generic_configurations,
    mobility,
    motor_rank,
)
from legcal.machine.equations import (
    constraints_at,
    leg_equations,
    n_pose_constraints,
)
from legcal.machine.files import LegcalBlock
from legcal.machine.formats import read_source
from legcal.machine.home import check_home_travel, closed_home, home_at_mid_travel
from legcal.machine.inspection import mechanism_notes, proposal_notes
from legcal.machine.leg import (
    MAX_LEGS,
    MAX_LENGTH,
    MAX_RADIUS,
    MIN_LENGTH,
    MIN_RADIUS,
    PERPENDICULAR,
    EquationKind,
    JointType,
    LegChain,
    redirected,
)
from legcal.machine.model import B_at, Machine, joint_values, vectors_A_to_B
from legcal.machine.origins import with_separate_origins
from legcal.machine.parameters import geometries, n_frame_legs, parametrization_of
from legcal.machine.rods import both_readings, rod_mode
from legcal.machine.shapes import (
    at_visible_heights,
    meshes_of,
    occluders_of,
    shapes_of,
    with_arms,
    with_covers,
    with_cylinders,
    with_mesh_cylinders,
)
from legcal.machine.spanning_tree import Source
from legcal.machine.ties import is_tied, machine_ties, n_dependent_at_home, n_nearly_dependent
from legcal.machine.tolerance import NOT_STATED
from legcal.machine.topology import (
    any_joint,
    check_virtual_joint,
    distinct_joint,
    find_chains,
    normals_in_links,
    normals_of_closures,
    plane_of_motion,
    propose_block,
    propose_frame,
)
from legcal.machine.urdf import VIRTUAL, Urdf

MAX_ORIGIN = 1e4  # largest joint origin [m]; beyond, floats do not resolve tolerances of joints
MAX_TURN = 4.0 * np.pi  # largest limit of an arm [rad]; limits beyond are most likely in degrees
_ROUNDING = 1e-9  # of home, which may lie on the floor [m]
_IN_SPACE = "a machine in space, or sliders along the legs", NOT_CALIBRATED
_DEVIATION = {  # messages, with an angle [deg]
    EquationKind.BASE_AXIS: "its revolute axis at the base {} deg from perpendicular to the leg",
    EquationKind.PLATFORM_AXIS: "its revolute axis at the platform {} deg from perpendicular to it",
    EquationKind.DIRECTION_1: "it turned {} deg in the platform to which it is fixed",
    EquationKind.DIRECTION_2: "it turned {} deg in the platform to which it is fixed",
    EquationKind.TWIST: "it twisted by {} deg although it has no S joint",
}


def load_mechanism(
    model: str | Path,
    *,
    without: Collection[str] = (),
    base: str | None = None,
    platform: str | None = None,
    leg_radius: float | None = None,
) -> Machine:
    """Return the mechanism of a file, with its legs classified from geometry.

    Parameters
    ----------
    model : str or Path
        A mechanism YAML, or a folder with ``robot.yaml``; a URDF with its YAML beside it (or in
        ``../models``) or with loops of its own; an MJCF file; or the name of a shipped model.
    without : collection of str
        Sliders of legs that are treated as passive although ``name_mot`` lists them.
    base, platform : str, optional
        Links of a file without a block ``legcal`` in which several could be meant.
    leg_radius : float, optional
        Radius [m] of the legs that the file draws without a cylinder.

    Raises
    ------
    ModelError
        If a file is missing, malformed or contradicts itself; all problems of a file at once.
    OutOfClass
        If the method does not support the mechanism.
    """
    source = read_source(model, base, platform)
    if without:
        source = replace(source, motors=tuple(m for m in source.motors if m not in without))
    return _load(replace(source, leg_radius=leg_radius))


def _load(source: Source) -> Machine:
    urdf = source.urdf
    # Beyond, rounding would hide the relative position of joints.
    for joint in urdf.joints.values():
        words = f"the origin of joint '{joint.name}' {{}} away from its parent link"
        away = float(np.linalg.norm(joint.T_parent_origin.translation))
        _check_length(away, words, urdf.path, most=MAX_ORIGIN)
    _check_names(source)
    # Base, platform and legs, stated or proposed; home from a drawing, if any.
    if source.motors:
        _check_plane_of_arms(urdf, source.path)  # before what could never make it a model is asked
    try:
        block = source.block or propose_block(source, source.motors)
        if block.home is None and source.poses is not None:
            T = source.poses[block.base].inv() * source.poses[block.platform]
            drawn_home = MotionEntry.model_validate(motion_to_xyz_quat(T))
            block = block.model_copy(update={"home": drawn_home})
        # In a fixed order, since sums depend on it.
        ordered = sorted(source.closures, key=lambda closure: (closure.frames, closure.kind))
        source = replace(source, closures=tuple(ordered))
        machine = _assemble(source, block)
    except OutOfClass:
        _check_plane_of_arms(urdf, source.path)
        raise
    bodies = rigid_bodies(source.urdf, source.closures, block.platform_joint)
    drawn, round_parts = with_mesh_cylinders(
        source.urdf, bodies, machine.legs, machine.base, source.leg_radius
    )
    if source.leg_radius is not None and drawn is source.urdf:
        raise UsageError(
            f"{source.path}: the leg radius (--leg-radius) could not be used: found that every leg "
            f"has a cylinder in {urdf.path}, needed a leg without; correct the radius there."
        )
    if round_parts or drawn is not source.urdf:
        source = replace(source, urdf=drawn, notes=(*source.notes, *round_parts))
        machine = _assemble(source, block)
    urdf, closures = with_separate_origins(source.urdf, source.closures, machine)
    if urdf is not source.urdf:
        machine = _assemble(replace(source, urdf=urdf, closures=closures), block)
        bodies = rigid_bodies(urdf, closures, block.platform_joint)
    machine = _with_occluders(machine, bodies)
    # A closed home.
    given = machine.home if block.home is not None else None
    if given is not None and source.is_drawn_open and not machine.actuators:
        _check_spread(machine)
        with suppress(DidNotConverge):  # travels are better evidence than the poses of open loops
            given = home_at_mid_travel(machine)
            machine = replace(machine, home=given)
            block = block.model_copy(update={"home": None})
    if given is None:
        _check_spread(machine)  # before a search for home in kilometres
        if machine.actuators:
            stated = block.home_readings or {}
            q = [stated.get(leg.motor_label, 0.5 * sum(leg.travel)) for leg in machine.legs]
            given = home_at_mid_travel(machine, q)
            machine = _in_modes(machine, given, q)
    else:
        if machine.actuators:
            q = _readings_at_home(machine, block.home_readings or {}, source.drawn)
            machine = _in_modes(machine, machine.home, q)
        _check_unit(machine)  # before lengths of hundreds of metres fail to close
    if source.block is not None and source.block.home is not None:  # a drawing may be anywhere
        check_home_travel(machine)
    try:
        pose, configuration = closed_home(machine, given)
    except (ModelError, DidNotConverge):
        missed = np.abs(constraints_at(machine, machine.home).values).max(initial=0.0)
        if missed <= MAX_POSE_ERROR * machine.size:
            _check_dependence(machine, closes=False)
        raise
    machine = replace(machine, home=pose, home_configuration=configuration)
    _check_unit(machine)
    _check_reach(machine)
    # The geometry must agree with Pinocchio.
    _check_across(machine)
    configurations = generic_configurations(machine, CONFIGURATIONS)
    machine = replace(machine, mobility=mobility(machine, configurations))
    machine = replace(machine, motor_rank=motor_rank(machine, configurations))
    _check_equations(machine, configurations)
    _check_dependence(machine)
    _check_ties(machine)
    proposed = proposal_notes(source.block, machine)
    notes = mechanism_notes(machine, home_is_given=block.home is not None)
    return replace(machine, diagnostics=(*source.notes, *proposed, *notes))


def _assemble(source: Source, block: LegcalBlock) -> Machine:
    """Return the mechanism, with its chain still open and nothing that hides its legs."""
    urdf, closures, yaml_path = source.urdf, source.closures, source.path
    bodies = rigid_bodies(urdf, closures, block.platform_joint)
    chains = _legs_in_order(
        find_chains(bodies, urdf, block.base, block.platform, source.motors),
        bodies,
        urdf,
        block,
        yaml_path,
    )
    _check_motors(source.motors, chains, urdf, yaml_path)
    ends = bodies.T_body_link[block.base], bodies.T_body_link[block.platform]
    normals = plane_of_motion(chains)
    _check_legs(chains, spatial=normals is None, path=yaml_path)
    check_virtual_joint(block, bodies, urdf, normals, yaml_path)
    in_plane = None if normals is None else normals_in_links(normals, ends)
    shown = [solid.cylinder for solid in shapes_of(urdf) if solid.cylinder is not None]
    if normals is not None:
        chains = at_visible_heights(chains, shown, bodies)
    stated = {joint: entry.gain for joint, entry in (block.motors or {}).items()}
    gains = {str(c.motor): stated.get(str(c.motor), 1.0) for c in chains if c.actuator is not None}
    across = normals_of_closures(in_plane, closures, block, urdf)
    chain = ClosedChain.of(urdf, closures, across, gains)
    home = None if block.home is None else block.home.motion()
    actuators = _actuators(chains, block, urdf, ends[0], yaml_path)
    legs = tuple(
        leg_of(
            name,
            leg_chain,
            ends,
            travel=_travel(leg_chain, urdf),
            actuated=leg_chain.motor in source.motors,
            spatial=normals is None,
            home=home,
            actuator=actuators.get(leg_chain.motor),
        )
        for name, leg_chain in zip(block.legs, chains, strict=True)
    )
    names = list(block.legs)
    base_normal, platform_normal = in_plane or (None, None)
    base_frame = block.base_frame or propose_frame(names, chains)
    frame_legs = tuple(names.index(name) for name in base_frame)
    legs = redirected(legs, frame_legs) if normals is None else legs
    legs = with_arms(with_cylinders(legs, shown, bodies), shown, bodies, ends[0])
    machine = Machine(
        name=urdf.name,
        yaml_path=yaml_path,
        urdf_path=urdf.path,
        base=block.base,
        platform=block.platform,
        platform_joint=block.platform_joint,
        legs=legs,
        frame_legs=frame_legs,
        spatial=normals is None,
        home=RigidTransform.identity() if home is None else home,
        home_configuration=chain.neutral(),
        chain=chain,
        urdf=urdf,
        base_normal=base_normal,
        platform_normal=platform_normal,
        tolerance=block.built or NOT_STATED,
        spline_teeth=block.spline_teeth,
        reach=block.reach or math.inf,
        floor=-math.inf if block.floor is None else block.floor,
    )
    _check_frames(machine)
    return machine


def _with_occluders(machine: Machine, bodies: Bodies) -> Machine:
    """Return the machine with all visuals that are not measured: CAD has meshes of megabytes."""
    normal, other = machine.base_normal, machine.platform_normal
    in_plane = None if normal is None or other is None else (normal, other)
    occluders = occluders_of(
        machine.legs,
        [*shapes_of(machine.urdf), *meshes_of(machine.urdf)],
        bodies,
        (machine.base, machine.platform),
        in_plane,
    )
    return replace(machine, legs=with_covers(machine.legs, occluders), occluders=occluders)


def _actuators(
    chains: Sequence[LegChain], block: LegcalBlock, urdf: Urdf, T_body_base: Array, path: Path
) -> dict[str | None, Actuator]:
    """Return the actuators by joint, with their numbers from the YAML."""
    stated = {
        chain.motor: actuator_of(
            chain, T_body_base, _travel(chain, urdf), urdf.joints[str(chain.motor)].child
        )
        for chain in reversed(chains)  # its point is on the first leg
        if chain.actuator is not None
    }
    problems, motors = Problems(path), sorted(str(motor) for motor in stated)
    for key, named in (("motors", block.motors), ("home_readings", block.home_readings)):
        for name in named or {}:
            if name not in motors:
                problems.add(
                    f"legcal.{key}.{name} could not be used",
                    "no motor of that name that carries rods",
                    f"one of {', '.join(motors)}" if motors else "no entry",
                    closest(name, motors) if motors else "remove it: sliders along legs carry none",
                    name=f"legcal.{key}.{name}",
                )
    problems.raise_if_any()
    for name, entry in (block.motors or {}).items():
        actuator, entry_name = stated[name], f"legcal.motors.{name}"
        refused = f"{entry_name} could not be used"
        try:
            pulses = Pulses.stated(entry.centre_us, entry.us_per_deg, turns=actuator.turns)
        except BadValue as bad:
            problems.add(refused, bad.found, bad.needed, bad.remedy, name=entry_name)
        else:
            stated[name] = replace(actuator, gain=entry.gain, pulses=pulses)
    problems.raise_if_any()
    return stated


def _travel(chain: LegChain, urdf: Urdf) -> tuple[float, float]:
    """Return the limits of the slider or actuator of a leg [m or rad], zero for a rod."""
    limits = None if chain.motor is None else urdf.joints[chain.motor].limits
    return (0.0, 0.0) if limits is None else limits


def _in_modes(machine: Machine, T_base_platform: RigidTransform, q: Sequence[float]) -> Machine:
    """Return the machine with its rods on actuators in the mode of a pose and joint values."""
    B = B_at(machine, T_base_platform.as_matrix()[None])[0]
    legs = tuple(
        leg if leg.actuator is None else replace(leg, mode=rod_mode(leg, float(q_j), B_j))
        for leg, q_j, B_j in zip(machine.legs, q, B, strict=True)
    )
    return replace(machine, legs=legs)


def _readings_at_home(
    machine: Machine, given: Mapping[str, float], drawn: Mapping[str, float]
) -> list[float]:
    """Return the joint values at home: as *given* for actuators, else those within the travel.

    If both readings at which a rod reaches the platform are within the travel, the one *drawn* in
    the file is taken; without one they are refused.
    """
    path = machine.yaml_path
    B = B_at(machine, machine.home.as_matrix()[None])[0]
    q = [0.0] * machine.n_legs
    for j, leg in enumerate(machine.legs):
        if leg.actuator is None:
            continue
        joint = leg.actuator.joint
        readings = both_readings(leg, B[j])
        size, unit = SHOWN_IN[leg.reading_unit]
        choices = f"the readings {size * readings[0]:.1f} and {size * readings[1]:.1f} {unit}"
        inside = [bool(leg.in_travel(np.array([x]))[0]) for x in readings]
        near = given.get(joint)
        if near is not None and not leg.in_travel(np.array([near]))[0]:
            raise ModelError(
                f"legcal.home_readings.{joint} could not be used",
                f"{near:g} {leg.reading_unit}, outside the travel of "
                f"{leg.travel[0]:.4g} to {leg.travel[1]:.4g} {leg.reading_unit}",
                f"the one of {choices} at home",
                f"correct it{', in radians' * leg.reads_angle}",
                path,
            )
        if near is None and all(inside):
            near = drawn.get(joint)
            if near is None and abs(np.diff(readings)[0]) > 1e-6 * np.ptp(leg.travel):
                raise ModelError(
                    f"the assembly of leg '{leg.name}' at home is ambiguous",
                    f"that its rod reaches the platform at {choices} of '{joint}', both inside "
                    "its travel",
                    "one",
                    f"{machine.urdf.wording.state_readings}, or narrow the limits of the joint",
                    path,
                )
        if near is None:
            near = readings[inside.index(True)] if any(inside) else 0.5 * sum(leg.travel)
        q[j] = min(readings, key=lambda x: abs(x - near))
    return q


def _legs_in_order(
    chains: Sequence[LegChain], bodies: Bodies, urdf: Urdf, block: LegcalBlock, path: Path
) -> list[LegChain]:
    """Return the leg chains in the order of the YAML; each must have a name there."""
    problems, ordered = Problems(path), list[LegChain]()
    owner: dict[int, str] = {}
    for name, joint in block.legs.items():
        matches = [c for c in chains if _is_on(joint, c, bodies, urdf)]
        if not matches:
            problems.add(
                f"legcal.legs.{name} could not be used",
                f"the joint '{joint}', which is on no leg between base and platform",
                "one that moves with the leg",
                "name its prismatic joint",
            )
        elif id(matches[0]) in owner:
            problems.add(
                f"legcal.legs.{name} could not be used",
                f"'{joint}' on the leg that is already named '{owner[id(matches[0])]}'",
                "a leg of its own",
                "correct it",
            )
        else:
            owner[id(matches[0])] = name
            ordered.append(matches[0])
    problems.raise_if_any()
    for chain in chains:
        if id(chain) not in owner:
            problems.add(
                "legcal.legs is incomplete",
                f"no name for the leg with joint '{distinct_joint(chain)}'",
                "every leg",
                "add a line for it",
            )
    problems.raise_if_any()
    return ordered


def _is_on(joint: str, chain: LegChain, bodies: Bodies, urdf: Urdf) -> bool:
    if any(step.joint == joint for step in chain.steps):
        return True
    entry = urdf.joints[joint]
    return not entry.moves and bodies.body_of[entry.child] in chain.bodies


def _check_names(source: Source) -> None:
    block, urdf = source.block, source.urdf
    links, joints = set(urdf.links), set(urdf.joints)
    named: list[tuple[str, str, str, set[str]]] = [
        *((f"name_mot.{i}", joint, "joint", joints) for i, joint in enumerate(source.motors)),
        *(
            (f"closed_loop.{i}.{k}", frame, "frame (link or joint)", links | joints)
            for i, closure in enumerate(source.closures)
            for k, frame in enumerate(closure.frames)
        ),
    ]
    if block is not None:
        named += [
            ("legcal.base", block.base, "link", links),
            ("legcal.platform", block.platform, "link", links),
            *((f"legcal.legs.{leg}", joint, "joint", joints) for leg, joint in block.legs.items()),
        ]
        if block.platform_joint is not None:
            named.append(("legcal.platform_joint", block.platform_joint, "joint", joints))
    problems = Problems(source.path)
    for place, name, kind, candidates in named:
        if name not in candidates:
            problems.add(
                f"{place} could not be used",
                f"the {kind} '{name}', which is not in {urdf.path.name}",
                remedy=closest(name, sorted(candidates)),
            )
    for i, closure in enumerate(source.closures):
        first, second = closure.frames
        if first == second:
            place = f"closed_loop.{i} could not be used"
            problems.add(place, f"'{first}' twice", "two frames", "correct one of them")
    _check_neighbours(source, problems)
    if block is not None and block.base == block.platform:
        problems.add(
            "legcal.platform could not be used",
            f"the link '{block.base}' as base and as platform",
            "two links",
            "correct one of them",
        )
    problems.raise_if_any()


def _check_neighbours(source: Source, problems: Problems) -> None:
    """Note closures that name the frame of a neighbour instead of their own.

    Legs that meet in a point may share a frame: then no similar frame beside it is unused.
    """
    urdf, places = source.urdf, dict[str, list[int]]()
    for i, closure in enumerate(source.closures):
        for frame in set(closure.frames):
            places.setdefault(frame, []).append(i)
    above = urdf.above
    parents = {joint.parent for joint in urdf.joints.values()}
    spare = {
        link: joint.parent
        for link, joint in above.items()
        if not joint.moves and not {link, joint.name} & places.keys() and link not in parents
    }
    for frame, closures in places.items():
        if len(closures) == 1 or frame not in above:
            continue
        beside = [link for link, parent in spare.items() if parent == above[frame].parent]
        if spared := nearest(frame, beside):
            *others, last = closures
            named = " and ".join(f"closed_loop.{i}" for i in others)
            problems.add(
                f"closed_loop.{last} could not be used",
                f"the frame '{frame}', which {named} name{'s' * (len(others) == 1)} too, and "
                f"'{spared}' in no closure",
                remedy=f"write '{spared}' in one of them, or remove it from {urdf.path.name} "
                "where these legs meet in one point",
            )


def _check_legs(chains: Sequence[LegChain], *, spatial: bool, path: Path) -> None:
    """Check the number of legs and, in a plane, that their type is supported."""
    n, n_d = len(chains), n_frame_legs(spatial=spatial)
    holding = [any_joint(chain) or "of a closure" for chain in chains if chain.is_joint]
    fixed = [any_joint(chain) for chain in chains if chain.platform.type is JointType.FIXED]
    on_motors = any(chain.actuator is not None for chain in chains)
    for is_so, found, needed, remedy in (
        (
            n < n_d,
            f"{n} {'leg' if n == 1 else 'legs'} {_where(spatial=spatial)}",
            f"at least {n_d}, whose joints define the frames of base and platform",
            NOT_CALIBRATED,
        ),
        (
            n > MAX_LEGS,
            f"{n} legs",
            f"at most {MAX_LEGS}, since the work grows with their cube",
            "leave out passive legs",
        ),
        (
            len(holding) > 1,
            f"{len(holding)} joints directly between base and platform ({', '.join(holding)})",
            "one at most, which holds the platform",
            "check that each leg has its links between these joints",
        ),
        (
            not spatial and fixed,
            f"the leg of joint '{fixed[0] if fixed else ''}' fixed to the platform of a planar "
            "mechanism",
            "a revolute joint there",
            NOT_CALIBRATED,
        ),
        (
            not spatial and on_motors,
            "a planar machine whose joints at A move on carriages or arms",
            *_IN_SPACE,
        ),
    ):
        if is_so:
            raise OutOfClass("this mechanism is not supported", found, needed, remedy, path)


def _where(*, spatial: bool) -> str:
    return "in space" if spatial else "in a plane"


def _check_plane_of_arms(urdf: Urdf, path: Path) -> None:
    """Refuse a machine of arms with parallel axes, such as a five-bar or a 3-RRR."""
    moving = [joint for joint in urdf.joints.values() if joint.moves and joint.type not in VIRTUAL]
    if len(moving) < 2 or any(joint.type == "prismatic" for joint in moving):
        return
    axes = [urdf.poses[joint.child].rotation.apply(joint.axis) for joint in moving]
    if all(parallel(axes[0], axis) for axis in axes):
        found = f"a planar machine of arms: all its {len(axes)} axes are parallel"
        raise OutOfClass("this mechanism is not supported", found, *_IN_SPACE, path)


def _check_motors(
    motors: Sequence[str], chains: Sequence[LegChain], urdf: Urdf, path: Path
) -> None:
    """Check that every motor is the slider of a leg, or carries rods."""
    moving = {chain.motor for chain in chains}
    problems = Problems(path)
    for motor in motors:
        joint = urdf.joints[motor]
        lower, upper = joint.limits or (0.0, 0.0)
        fault = None
        if motor not in moving and joint.type == "prismatic":
            fault = "it on no leg", "the slider of a leg", "remove it from name_mot"
        elif motor not in moving:
            fault = (
                f"a {joint.type} joint in name_mot that does not stand between the base and an "
                "arm with rods",
                "sliders of legs, or joints on the base that carry the joints of rods",
                f"remove it from name_mot if it has no motor, otherwise {NOT_CALIBRATED}",
            )
        elif joint.type == "continuous":
            fault = (
                "a continuous joint",
                "one with the limits of its readings",
                "write its type as revolute, with <limit>",
            )
        elif joint.type == "revolute" and max(abs(lower), abs(upper)) > MAX_TURN:
            fault = (
                f"the limits {lower:g} to {upper:g} rad",
                "at most two turns either way",
                "these look like degrees: write its limits, and its readings, in radian",
            )
        if fault is not None:
            problems.add(f"the motor '{motor}' could not be used", *fault)
    problems.raise_if_any(OutOfClass)


def _check_frames(machine: Machine) -> None:
    """Check that the joint centres of the frame legs span a frame on base and platform."""
    n_d = n_frame_legs(spatial=machine.spatial)
    chosen = [machine.leg_names[j] for j in machine.frame_legs]
    refused, problems = "legcal.base_frame could not be used", Problems(machine.yaml_path)
    if len(chosen) != n_d:
        needed = f"{n_d} for a mechanism {_where(spatial=machine.spatial)}"
        found = f"{len(chosen)} legs ({', '.join(chosen)})"
        problems.add(refused, found, needed, f"name {n_d} legs")
    problems.raise_if_any()
    for side in ("base", "platform"):
        try:
            _ = machine.T_base_Rb if side == "base" else machine.T_platform_Re
        except ValueError:
            problems.add(
                refused,
                f"{side} joints of {', '.join(chosen)} in one point or on one line",
                "three that span a plane" if n_d == 3 else "two that lie apart in the plane",
                "choose other legs",
            )
    problems.raise_if_any()


def _check_reach(machine: Machine) -> None:
    """Check that reach and floor let the platform be at home, from where all poses are drawn."""
    problems, (x, y, z) = Problems(machine.yaml_path), machine.home.translation.tolist()
    away, remedy = math.hypot(x, y), "write it in metres, or correct home"
    if away > machine.reach + _ROUNDING:
        found = f"{machine.reach:g} m, with home {away:.4g} m from the z axis of the base"
        problems.add("the reach could not be used", found, "home inside it", remedy)
    if z < machine.floor - _ROUNDING:
        found = f"{machine.floor:g} m, with home at z = {z:.4g} m"
        problems.add("the floor could not be used", found, "home above it", remedy)
    problems.raise_if_any()


def _check_length(
    length: float, words: str, path: Path, least: float = 0.0, most: float = MAX_LENGTH
) -> None:
    """Refuse a length [m] that is most likely in another unit, with *words* for it."""
    if not least <= length <= most:
        raise ModelError(
            "the lengths could not be used",
            words.format(f"{length:.4g} m"),
            f"{least:g} to {most:g} m" if least else f"at most {most:g} m",
            "write all lengths in metres (are they millimetres?)",
            path,
        )


def _check_spread(machine: Machine) -> None:
    """Check that the joints are within metres of each other, before the search for home."""
    for side, joints in (("base", machine.A_base), ("platform", machine.B_platform)):
        size = float(np.linalg.norm(np.ptp(joints, axis=0)))
        _check_length(size, f"the joints on the {side} {{}} apart", machine.urdf_path)


def _check_unit(machine: Machine) -> None:
    """Check that leg lengths at home, travels and radii are plausible in metres."""
    path = machine.urdf_path
    lengths = np.linalg.norm(vectors_A_to_B(machine, machine.home), axis=1)
    fixed = np.array([leg.is_fixed_to_platform for leg in machine.legs])
    for leg, length in zip(machine.legs, lengths.tolist(), strict=True):
        if not leg.is_fixed_to_platform:
            _check_length(length, f"leg '{leg.name}' {{}} long at home", path, MIN_LENGTH)
    for leg in machine.legs:
        if leg.is_motor and not leg.reads_angle:
            reach = leg.travel[1] - leg.travel[0]
            _check_length(reach, f"a travel of {{}} of leg '{leg.name}'", path)
    for leg, length in zip(machine.legs, np.where(fixed, lengths.max(), lengths), strict=True):
        seen = [(c.link, c.radius, f"along leg '{leg.name}'") for c in leg.cylinders]
        if leg.arm is not None:
            seen.append((leg.arm.link, leg.arm.radius, f"on the arm of leg '{leg.name}'"))
        for link, radius, where in seen:
            if not MIN_RADIUS < radius / length < MAX_RADIUS:
                raise ModelError(
                    f"the <visual> cylinder of link '{link}' could not be used",
                    f"a radius of {1e3 * radius:.4g} mm {where}, which is {1e3 * length:.4g} "
                    "mm long at home",
                    f"{MIN_RADIUS:g} to {MAX_RADIUS:g} of the length",
                    "correct radius and its unit",
                    path,
                )


def _check_dependence(machine: Machine, *, closes: bool = True) -> None:
    """Check that dependent constraints are dependent exactly; *closes*: the machine closes at home.

    If some are nearly dependent, the machine lacks its intended mobility.
    """
    nearly = n_nearly_dependent(machine)
    # If home is a special pose, constraints are dependent there exactly and around it nearly.
    if nearly > (n_dependent_at_home(machine) if closes else 0):
        n = n_pose_constraints(machine.legs)
        raise OutOfClass(
            f"the mechanism '{machine.name}' could not be used",
            f"that {nearly} of the {n} constraints of its joints follow from the "
            "others to 1 mrad but not exactly",
            "exactly dependent constraints in an overconstrained machine",
            "write parallel, perpendicular or intersecting axes with all digits (12 decimals "
            "or more)",
            machine.yaml_path,
        )


def _check_ties(machine: Machine) -> None:
    """Check that an overconstrained machine keeps its mobility with small errors."""
    ties, n = machine_ties(machine), n_pose_constraints(machine.legs)
    if machine.actuators and n_dependent_at_home(machine):
        joints = {joint for leg in machine.legs for joint in (leg.base_joint, leg.platform_joint)}
        remedy = "give its rods spherical joints"
        if joints == {JointType.SPHERICAL}:
            remedy = (
                "leave out redundant rods (between the same joints as another, a third one on a "
                f"motor, those of a fourth arm), otherwise {NOT_CALIBRATED}"
            )
        raise OutOfClass(
            f"the mechanism '{machine.name}' is not supported",
            f"an overconstrained machine ({n_dependent_at_home(machine)} of the {n} "
            "constraints of its joints follow from the others) with moving joints at A",
            "independent constraints",
            remedy,
            machine.yaml_path,
        )
    if not is_tied(geometries(machine), ties, parametrization_of(machine, twists=True)):
        raise OutOfClass(
            f"the mechanism '{machine.name}' is not supported",
            f"an overconstrained machine ({ties.n_dependent} of the {n} constraints of its "
            f"joints follow from the others) that loses its mobility {machine.mobility} with "
            "small errors of its parameters, however they are tied",
            "parameters with errors that keep the mobility",
            "give a leg another joint, or leave out a leg without a motor",
            machine.yaml_path,
        )


def _check_across(machine: Machine) -> None:
    """Check that the closures of a planar mechanism also hold across its plane."""
    within = joint_tolerance((machine.A_base, machine.B_platform))
    row, residual = 0, machine.chain.residual(machine.home_configuration)
    problems = Problems(machine.yaml_path)
    for closure in machine.chain.closures:
        gap = float(np.linalg.norm(residual[row : row + 3]))
        tilt = float(np.linalg.norm(residual[row + 3 : row + closure.rows]))
        row += closure.rows
        if gap > within or tilt > PERPENDICULAR:
            problems.add(
                "the loops could not be closed",
                f"{closure} {1e3 * gap:.3g} mm and "
                f"{np.degrees(tilt):.3f} deg apart across the plane in which the legs move",
                f"at most {1e3 * within:.2g} mm and {np.degrees(PERPENDICULAR):.2g} deg",
                "correct the origins and axes along this leg",
            )
    problems.raise_if_any(OutOfClass)


def _check_equations(machine: Machine, configurations: Sequence[Array]) -> None:
    """Check the equations of all legs against Pinocchio at closed configurations.

    The closed configurations come from the URDF alone, the equations from the classified geometry:
    both must describe the same machine. Origins and axes in files are rounded, so the tolerances of
    joints apply, and 1 mrad to axes, directions and twists.
    """
    poses = [machine.chain.placement(c, machine.base, machine.platform) for c in configurations]
    R, t = np.array([R for R, _ in poses]), np.array([t for _, t in poses])
    q = np.array([joint_values(machine, c) for c in configurations])
    problems = Problems(machine.yaml_path)
    within = joint_tolerance((machine.A_base, machine.B_platform))
    for j, leg in enumerate(machine.legs):
        equations = leg_equations(leg, R, t, by_local=False, q=q[:, j])
        values = equations.values.copy()
        if leg.actuator is None:
            values[:, 0] -= leg.sign * q[:, j]
        kinds = [*equations.kinds] * len(R)
        for kind, value in zip(kinds, np.abs(values).ravel().tolist(), strict=True):
            if (broken := _broken_equation(kind, value, within)) is not None:
                problems.add(
                    f"leg '{leg.name}' is not supported",
                    f"{broken} at a closed pose",
                    remedy="check the origins and axes along the leg",
                )
                break
    problems.raise_if_any(OutOfClass)


def _broken_equation(kind: EquationKind, value: float, within: float) -> str | None:
    """Return the violation of an equation in words, None if it holds; lengths *within* [m]."""
    if kind is EquationKind.LENGTH:
        if value <= within:
            return None
        return (
            f"its length {1e3 * value:.3g} mm from reading plus offset, needed at most "
            f"{1e3 * within:.2g} mm,"
        )
    if value <= PERPENDICULAR:
        return None
    angle = f"{np.degrees(np.arcsin(min(value, 1.0))):.3g}"
    return f"{_DEVIATION[kind].format(angle)}, needed at most {np.degrees(PERPENDICULAR):.2g} deg,"
