"""Whether a mechanism YAML and its URDF agree: names, the class covered, legs, length law."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from legcal.errors import ModelError, OutOfClass
from legcal.files.schema import closest
from legcal.geometry.frames import frame_on_points
from legcal.mechanism.bodies import Bodies
from legcal.mechanism.closing import leg_vectors, platform_pose, slider_columns
from legcal.mechanism.leg import Leg, LegKind
from legcal.mechanism.mobility import generic_configurations
from legcal.mechanism.model import Mechanism
from legcal.mechanism.schema import MechanismFile
from legcal.mechanism.topology import LegChain
from legcal.mechanism.urdf import Urdf

LENGTH_LAW = 1e-9  # [m]


def check_names(file: MechanismFile, urdf: Urdf, path: Path) -> None:
    """Check that the URDF has every link and joint that the YAML names.

    Raises
    ------
    ModelError
        With one sentence for each unknown name.
    """
    block = file.legcal
    links, joints = set(urdf.links), set(urdf.joints)
    named: list[tuple[str, str, str, set[str]]] = [
        ("legcal.base", block.base, "link", links),
        ("legcal.platform", block.platform, "link", links),
        *((f"legcal.legs.{leg}", joint, "joint", joints) for leg, joint in block.legs.items()),
        *((f"name_mot.{i}", joint, "joint", joints) for i, joint in enumerate(file.name_mot)),
        *(
            (f"closed_loop.{i}.{k}", frame, "frame (link or joint)", links | joints)
            for i, pair in enumerate(file.closed_loop)
            for k, frame in enumerate(pair)
        ),
    ]
    if block.platform_joint is not None:
        named.append(("legcal.platform_joint", block.platform_joint, "joint", joints))
    problems = [
        _unknown(path, place, name, what, urdf, known)
        for place, name, what, known in named
        if name not in known
    ]
    problems += [
        f"{path}: closed_loop.{i} could not be used: found '{one}' twice, needed two frames; "
        "correct one of them."
        for i, (one, two) in enumerate(file.closed_loop)
        if one == two
    ]
    if block.base == block.platform:
        problems.append(
            f"{path}: legcal.platform could not be used: found the link '{block.base}' as base and "
            "as platform, needed two links; correct one of them."
        )
    if problems:
        raise ModelError(problems)


def check_class(file: MechanismFile, urdf: Urdf, path: Path) -> None:
    """Check that motors are sliders and that the virtual joint is one that is covered.

    Raises
    ------
    OutOfClass
        With one sentence for each joint that is not.
    """
    problems = [
        f"{path}: the motor '{name}' is outside the method: found a {urdf.joints[name].type} joint "
        "in name_mot, needed prismatic joints, whose readings are leg lengths; this machine "
        "cannot be calibrated this way."
        for name in file.name_mot
        if urdf.joints[name].type != "prismatic"
    ]
    virtual = file.legcal.platform_joint
    if virtual is not None and urdf.joints[virtual].type != "floating":
        problems.append(
            f"{path}: legcal.platform_joint '{virtual}' is not covered: found a "
            f"{urdf.joints[virtual].type} joint, needed a floating one (planar mechanisms are not "
            "covered yet); correct it, or write null if a leg carries the platform."
        )
    if file.joint_name or file.joint_type:
        problems.append(
            f"{path}: joint_name and joint_type are not covered: found {len(file.joint_name)} "
            "joints that stand for others, needed none; write these joints as revolutes, or cut "
            "the loop there."
        )
    if len(file.legcal.base_frame) != 3:
        problems.append(
            f"{path}: legcal.base_frame is not covered: found {len(file.legcal.base_frame)} legs, "
            "needed 3 for a mechanism in space; name three legs."
        )
    if problems:
        raise OutOfClass(problems)


def legs_in_order(
    chains: Sequence[LegChain], bodies: Bodies, urdf: Urdf, file: MechanismFile, path: Path
) -> list[LegChain]:
    """Return the leg chains in the order of the YAML.

    Raises
    ------
    ModelError
        If a name means no leg, or two mean the same, or a leg has none.
    OutOfClass
        If a leg has other joints than S or U with an S, or a motor is on no leg.
    """
    problems, ordered = [], list[LegChain]()
    owner: dict[int, str] = {}
    for name, joint in file.legcal.legs.items():
        found = [c for c in chains if _is_on(joint, c, bodies, urdf)]
        if not found:
            problems.append(
                f"{path}: legcal.legs.{name} could not be used: found the joint '{joint}', which "
                "is on no leg between base and platform, needed one that moves with the leg; name "
                "its prismatic joint."
            )
        elif id(found[0]) in owner:
            problems.append(
                f"{path}: legcal.legs.{name} could not be used: found '{joint}' on the leg that "
                f"is already named '{owner[id(found[0])]}', needed a leg of its own; correct it."
            )
        else:
            owner[id(found[0])] = name
            ordered.append(found[0])
    problems += [
        f"{path}: legcal.legs is incomplete: found no name for the leg with joint "
        f"'{_any_joint(chain)}', needed every leg; add a line for it."
        for chain in chains
        if id(chain) not in owner and not problems
    ]
    if problems:
        raise ModelError(problems)
    _check_types(file, ordered, path)
    return ordered


def check_frames(legs: Sequence[Leg], frame_legs: Iterable[int], path: Path) -> None:
    """Check that the joint centres of the frame legs span a frame on base and platform.

    Raises
    ------
    ModelError
        If they coincide or are collinear.
    """
    problems = []
    for side in ("base", "platform"):
        points = [leg.A_base if side == "base" else leg.B_platform for leg in legs]
        chosen = [legs[j].name for j in frame_legs]
        try:
            frame_on_points(np.array([points[j] for j in frame_legs]))
        except ValueError:
            problems.append(
                f"{path}: legcal.base_frame could not be used: found {side} joints of "
                f"{', '.join(chosen)} in one point or on one line, needed three that span a plane; "
                "choose other legs."
            )
    if problems:
        raise ModelError(problems)


def check_length_law(mechanism: Mechanism) -> None:
    """Check L = sign q + q0 against Pinocchio at two closed configurations.

    Raises
    ------
    OutOfClass
        If a leg does not keep it to 1e-9 m.
    """
    for configuration in generic_configurations(mechanism, 2):
        if np.abs(mechanism.chain.residual(configuration)).max() > 1e-11:
            continue  # the little step did not close: home alone decides
        T_base_platform = platform_pose(mechanism, configuration)
        lengths = np.linalg.norm(leg_vectors(mechanism, T_base_platform), axis=1)
        for j, leg in enumerate(mechanism.legs):
            q = 0.0
            if leg.kind is not LegKind.CONSTANT:
                q = float(configuration[slider_columns(mechanism, (j,))[0][0]])
            miss = abs(float(lengths[j]) - (leg.sign * q + leg.q0))
            if miss > LENGTH_LAW:
                raise OutOfClass(
                    f"{mechanism.yaml_path}: leg '{leg.name}' is outside the method: found its "
                    f"length {1e3 * miss:.3g} mm away from reading plus offset, needed at most "
                    f"{1e3 * LENGTH_LAW:.0e} mm; check the origins along the leg."
                )


def _check_types(file: MechanismFile, chains: Sequence[LegChain], path: Path) -> None:
    """Refuse legs whose joints are not covered, and motors that are not on them."""
    problems = []
    for name, chain in zip(file.legcal.legs, chains, strict=True):
        letters = chain.base.letter + chain.platform.letter
        if "S" not in letters or "R" in letters:
            slider = "P" if chain.slider is not None else ""
            problems.append(
                f"{path}: leg '{name}' is not covered: found the type "
                f"{letters[0]}{slider}{letters[1]}, needed an S joint at one end and an S or a U "
                "at the other (SPU, UPS, SPS); legs with R joints or without S are not covered yet."
            )
    sliders = {c.slider.connection.joint for c in chains if c.slider is not None}
    problems += [
        f"{path}: the motor '{motor}' is outside the method: found it on no leg, needed the slider "
        "of a leg; remove it from name_mot."
        for motor in file.name_mot
        if motor not in sliders
    ]
    if problems:
        raise OutOfClass(problems)


def _is_on(joint: str, chain: LegChain, bodies: Bodies, urdf: Urdf) -> bool:
    """Say whether a joint belongs to a leg."""
    if any(step.connection.joint == joint for step in chain.steps):
        return True
    entry = urdf.joints[joint]
    return not entry.moves and bodies.body_of[entry.child] in chain.bodies


def _any_joint(chain: LegChain) -> str:
    """Return a joint that names a leg for the reader."""
    if chain.slider is not None:
        return str(chain.slider.connection.joint)
    return next((s.connection.joint for s in chain.steps if s.connection.joint), "none")


def _unknown(path: Path, place: str, name: str, what: str, urdf: Urdf, known: set[str]) -> str:
    """Return that a name is not in the URDF."""
    return (
        f"{path}: {place} could not be used: found the {what} '{name}', which is not in "
        f"{urdf.path.name}; {closest(name, sorted(known))}"
    )
