"""Whether a mechanism YAML and its URDF agree: names, legs, motors, frames."""

from collections.abc import Sequence
from pathlib import Path

from legcal.errors import ModelError, OutOfClass
from legcal.files.schema import closest
from legcal.mechanism.bodies import Bodies
from legcal.mechanism.leg import MOST_LEGS
from legcal.mechanism.leg_chain import LegChain
from legcal.mechanism.model import Mechanism
from legcal.mechanism.parameters import n_frame_legs
from legcal.mechanism.proposal import any_joint
from legcal.mechanism.schema import LegcalBlock, MechanismFile
from legcal.mechanism.urdf import Urdf


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
        *((f"name_mot.{i}", joint, "joint", joints) for i, joint in enumerate(file.name_mot)),
        *(
            (f"closed_loop.{i}.{k}", frame, "frame (link or joint)", links | joints)
            for i, pair in enumerate(file.closed_loop)
            for k, frame in enumerate(pair)
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
    if block is not None and block.base == block.platform:
        problems.append(
            f"{path}: legcal.platform could not be used: found the link '{block.base}' as base and "
            "as platform, needed two links; correct one of them."
        )
    if problems:
        raise ModelError(problems)


def check_count(chains: Sequence[LegChain], *, spatial: bool, path: Path) -> None:
    """Check that there are as many legs as define a frame, not far more, no fixed one in a plane.

    Raises
    ------
    OutOfClass
        If there are fewer, or more than MOST_LEGS, or a leg of a planar mechanism is fixed to
        the platform.
    """
    n_d = n_frame_legs(spatial=spatial)
    if len(chains) < n_d:
        where = "in space" if spatial else "in a plane"
        raise OutOfClass(
            f"{path}: this mechanism is outside the method: found {len(chains)} "
            f"{'leg' if len(chains) == 1 else 'legs'} {where}, needed at least {n_d}, whose joints "
            "define the frames of base and platform; this machine cannot be calibrated this way."
        )
    if len(chains) > MOST_LEGS:
        raise OutOfClass(
            f"{path}: this mechanism is outside the method: found {len(chains)} legs, needed at "
            f"most {MOST_LEGS}, since the work grows with their cube; leave out passive legs."
        )
    fixed = [chain for chain in chains if chain.platform.letter == ""]
    if fixed and not spatial:
        raise OutOfClass(
            f"{path}: the leg of joint '{any_joint(fixed[0])}' is outside the method: found it "
            "fixed to the platform of a planar mechanism, needed a revolute joint there; this "
            "machine cannot be calibrated this way."
        )


def legs_in_order(
    chains: Sequence[LegChain], bodies: Bodies, urdf: Urdf, block: LegcalBlock, path: Path
) -> list[LegChain]:
    """Return the leg chains in the order of the YAML.

    Raises
    ------
    ModelError
        If a name means no leg, or two mean the same, or a leg has none.
    """
    problems, ordered = [], list[LegChain]()
    owner: dict[int, str] = {}
    for name, joint in block.legs.items():
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
        f"'{any_joint(chain)}', needed every leg; add a line for it."
        for chain in chains
        if id(chain) not in owner and not problems
    ]
    if problems:
        raise ModelError(problems)
    return ordered


def check_frames(mechanism: Mechanism) -> None:
    """Check that the joint centres of the frame legs span a frame on base and platform.

    Raises
    ------
    ModelError
        If they are too few or too many, coincide, or are collinear.
    """
    path, n_d = mechanism.yaml_path, n_frame_legs(spatial=mechanism.spatial)
    chosen = [mechanism.leg_names[j] for j in mechanism.frame_legs]
    if len(chosen) != n_d:
        where = "in space" if mechanism.spatial else "in a plane"
        raise ModelError(
            f"{path}: legcal.base_frame could not be used: found {len(chosen)} legs, needed {n_d} "
            f"for a mechanism {where}; name {n_d} legs."
        )
    problems = []
    for side in ("base", "platform"):
        try:
            _ = mechanism.T_base_Rb if side == "base" else mechanism.T_platform_Re
        except ValueError:
            needed = "three that span a plane" if n_d == 3 else "two that lie apart in the plane"
            problems.append(
                f"{path}: legcal.base_frame could not be used: found {side} joints of "
                f"{', '.join(chosen)} in one point or on one line, needed {needed}; choose other "
                "legs."
            )
    if problems:
        raise ModelError(problems)


def check_motors(file: MechanismFile, chains: Sequence[LegChain], urdf: Urdf, path: Path) -> None:
    """Check that every motor is the slider of a leg.

    Raises
    ------
    OutOfClass
        With one sentence for each motor that is not.
    """
    sliders = {c.slider.connection.joint for c in chains if c.slider is not None}
    problems = []
    for motor in file.name_mot:
        kind = urdf.joints[motor].type
        if kind != "prismatic":
            problems.append(
                f"{path}: the motor '{motor}' is outside the method: found a {kind} joint in "
                "name_mot, needed prismatic joints, whose readings are leg lengths; this machine "
                "cannot be calibrated this way."
            )
        elif motor not in sliders:
            problems.append(
                f"{path}: the motor '{motor}' is outside the method: found it on no leg, needed "
                "the slider of a leg; remove it from name_mot."
            )
    if problems:
        raise OutOfClass(problems)


def _is_on(joint: str, chain: LegChain, bodies: Bodies, urdf: Urdf) -> bool:
    """Say whether a joint belongs to a leg."""
    if any(step.connection.joint == joint for step in chain.steps):
        return True
    entry = urdf.joints[joint]
    return not entry.moves and bodies.body_of[entry.child] in chain.bodies


def _unknown(path: Path, place: str, name: str, what: str, urdf: Urdf, known: set[str]) -> str:
    """Return that a name is not in the URDF."""
    return (
        f"{path}: {place} could not be used: found the {what} '{name}', which is not in "
        f"{urdf.path.name}; {closest(name, sorted(known))}"
    )
