"""Models written with other numbers: a URDF with moved origins, and its YAML.

Written files are loaded again and checked.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.errors import DidNotConverge, ModelError
from legcal.files.folder import new_files
from legcal.files.motions import motion_to_xyz_quat
from legcal.files.schema import read_yaml
from legcal.geometry.motions import roll_pitch_yaw
from legcal.machine.files import (
    FILE_KIND,
    FOLDER_YAML,
    is_xml,
    mechanism_yaml,
    motor_entries,
    yaml_text,
)
from legcal.machine.home import home_of_legs
from legcal.machine.kinematics import forward_kinematics, inverse_kinematics
from legcal.machine.leg import Leg
from legcal.machine.loader import load_mechanism
from legcal.machine.meshes import mesh_file
from legcal.machine.model import Machine, readings_at
from legcal.machine.origins import moved_arms, moved_origins
from legcal.machine.parameters import (
    geometries,
    in_joint_frames,
    parametrization_of,
    vector_of,
)
from legcal.machine.rods import actuators_of
from legcal.machine.topology import distinct_joint
from legcal.machine.urdf import UrdfPatch, written

CLOSES = 2.5e-9  # tolerance of home and the pose at its readings [mean leg lengths, rad]
ROUNDING = 1e-15  # displacement that counts as none [mean leg lengths]
RELOAD_TOLERANCE = 2.5e-11  # mean leg lengths, [rad] between reloaded and written parameters
MAX_HOME_RESIDUAL = 0.2  # residual of calibrated legs at the nominal home [leg lengths]


def mechanism_text(machine: Machine, urdf: str) -> str:
    """Return the complete YAML of a mechanism."""
    closures = [(*c.frames, c.kind) for c in machine.chain.closures]
    motors = [str(machine.legs[j].prismatic) for j in machine.motors]
    return mechanism_yaml(closures, motors, _legcal_block(machine, urdf))


def _legcal_block(machine: Machine, urdf: str) -> dict[str, Any]:
    """Return the block ``legcal`` of the YAML of a mechanism."""
    q = readings_at(machine, machine.home)
    home = {str(machine.legs[j].prismatic): float(q[j]) for j in machine.motors
            if machine.legs[j].actuator is not None}  # fmt: skip
    stated = motor_entries(machine.actuators)
    return {
        "urdf": urdf,
        "base": machine.base,
        "platform": machine.platform,
        "platform_joint": machine.platform_joint,
        "base_frame": [machine.leg_names[j] for j in machine.frame_legs],
        "home": motion_to_xyz_quat(machine.home),
        **({"home_readings": home} if home else {}),
        **({"motors": stated} if stated else {}),
        **machine.tolerance.entries,
        **({} if machine.spline_teeth is None else {"spline_teeth": machine.spline_teeth}),
        **{key: x for key in ("reach", "floor") if math.isfinite(x := getattr(machine, key))},
        "legs": {leg.name: _joint_of(machine, leg) for leg in machine.legs},
    }


def model_name(machine: Machine) -> str:
    """Return the name for the files of a mechanism: that of its file, or of its folder."""
    path = machine.yaml_path
    return path.resolve().parent.name if path.name == FOLDER_YAML else path.stem


def write_model(machine: Machine, folder: Path) -> tuple[Path, Path]:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a mechanism.

    An unconverted URDF is copied byte for byte, but for lost paths of meshes.
    """
    name = model_name(machine)
    names = f"models/{name}.yaml", f"urdf/{name}.urdf"
    urdf = _with_paths(machine, folder / names[1])
    with new_files(folder, "model", names) as temporary:
        for path in names:
            (temporary / path).parent.mkdir()
        (temporary / names[0]).write_text(mechanism_text(machine, f"../{names[1]}"), "utf-8")
        (temporary / names[1]).write_bytes(urdf)
    return folder / names[0], folder / names[1]


def _with_paths(machine: Machine, destination: Path) -> bytes:
    """Return the URDF of a mechanism; meshes not found from a destination get absolute paths."""
    robot, changed = machine.urdf.robot(), False
    for mesh in robot.iterfind("link/*/geometry/mesh"):
        file = mesh_file(machine.urdf.path, mesh.get("filename", ""))
        if file is not None and mesh_file(destination, mesh.get("filename", "")) is None:
            mesh.set("filename", file.resolve().as_posix())
            changed = True
    return written(robot) if changed else machine.urdf.content


def _joint_of(machine: Machine, leg: Leg) -> str:
    """Return a joint that identifies a leg: one that moves, or any other of its own."""
    chain = leg.urdf_chain
    fixed = (joint.name for joint in machine.urdf.joints.values() if joint.child in chain.bodies)
    return distinct_joint(chain) or next(fixed)


def urdf_of(yaml: Path) -> Path:
    """Return the URDF beside the YAML of a written model."""
    return yaml.with_suffix(".urdf")


def write_calibrated(machine: Machine, legs: Sequence[Leg], yaml: Path) -> Machine:
    """Write a machine with calibrated legs, and return it as loaded again.

    Raises DidNotConverge if it does not load with these legs, or does not close near home.
    """
    start = f"{yaml}: the model could not be written: found"
    write_urdf(machine, legs, urdf_of(yaml))
    home = home_of_legs(machine, legs, MAX_HOME_RESIDUAL)
    if home is None:
        raise DidNotConverge(
            f"{start} no closed pose of its legs near legcal.home, needed one; check legcal.home "
            f"of {machine.yaml_path}, and the nominal model."
        )
    moved = None if home is machine.home else home
    write_calibrated_yaml(machine, yaml, urdf_of(yaml).name, moved, legs)
    loaded = reload_and_check(yaml)
    parametrization = parametrization_of(loaded, twists=True)
    wanted = in_joint_frames(legs, machine.frame_legs)
    difference = vector_of(parametrization, geometries(loaded), wanted) - vector_of(
        parametrization, wanted, wanted
    )
    unit = np.where([unit == "m" for unit in parametrization.units], machine.size, 1.0)
    error = float(np.abs(difference / unit).max())
    if not error <= RELOAD_TOLERANCE:
        raise DidNotConverge(
            f"{start} that its parameters, loaded again, differ by {error:.1e} leg lengths or rad "
            f"from the computed ones, needed at most {RELOAD_TOLERANCE:.0e}; please report this."
        )
    return loaded


def write_urdf(machine: Machine, legs: Sequence[Leg], destination: Path) -> None:
    """Write the URDF of a mechanism with other numbers of its legs, of any type.

    Loading it again gives these numbers to 1e-12 m and rad, with R_b and R_e unchanged. The visuals
    of arms move with their lines. Radii are not written, since they absorb the bias of edges. Home
    is not checked: with other rods or axes the mechanism may close elsewhere. Gains of motors that
    carry rods are in the YAML only.
    """
    patch = UrdfPatch(machine.urdf.content)
    for name, (after, is_turned) in moved_origins(machine, legs).items():
        before = machine.urdf.joints[name].T_parent_origin
        xyz = np.asarray(after.translation)
        stays = np.abs(xyz - before.translation).max() < ROUNDING * machine.size
        rpy = roll_pitch_yaw(after.rotation.as_matrix()) if is_turned else None
        if rpy is not None or not stays:
            patch.set_origin(name, None if stays else xyz, rpy)
    for arm, T in moved_arms(machine, legs):
        patch.move_cylinder(arm.link, (arm.radius, arm.length), T)
    destination.write_bytes(patch.content())


def write_calibrated_yaml(
    machine: Machine,
    destination: Path,
    urdf_name: str,
    home: RigidTransform | None = None,
    legs: Sequence[Leg] = (),
) -> None:
    """Write the mechanism's YAML with ``legcal.urdf`` naming the calibrated file.

    All other entries are kept, except ``legcal.home`` if home moves, and the gains of the motors of
    *legs* if they differ from the model. A mechanism of another format, or without a block
    ``legcal``, gets a complete YAML.
    """
    gains = {a.joint: a.gain for a in actuators_of(legs)}
    there = machine if home is None else replace(machine, home=home)
    there = replace(there, legs=tuple(_with_gain(leg, gains) for leg in there.legs))
    stated = (
        {} if is_xml(machine.yaml_path) else read_yaml(machine.yaml_path, FILE_KIND, ModelError)
    )
    closures = {c.frames for c in machine.chain.closures}
    if (
        stated.get("legcal") is not None
        and not stated.get("joint_name")
        and {(first, second) for first, second in stated["closed_loop"]} == closures
    ):
        block = stated["legcal"]
        changed = {"urdf"} | ({"home"} & block.keys() if home is not None else set())
        if any(a.gain != gains.get(a.joint, a.gain) for a in machine.actuators):
            changed.add("motors")
        complete = _legcal_block(there, urdf_name)
        stated["legcal"] = block | {key: complete.get(key) for key in changed}
        text = yaml_text(stated)
    else:
        text = mechanism_text(there, urdf_name)
    destination.write_bytes(text.encode("utf-8"))


def _with_gain(leg: Leg, gains: Mapping[str, float]) -> Leg:
    """Return a leg whose motor has its gain from a mapping by joint."""
    if leg.actuator is None:
        return leg
    gain = gains.get(leg.actuator.joint, leg.actuator.gain)
    return replace(leg, actuator=replace(leg.actuator, gain=gain))


def check_closes(machine: Machine) -> None:
    """Check that a mechanism closes at home, and that its readings lead back to it."""
    pose = forward_kinematics(machine, inverse_kinematics(machine, machine.home))
    away = machine.home.inv() * pose
    shift, turn = float(np.linalg.norm(away.translation)), float(away.rotation.magnitude())
    if not max(shift / machine.size, turn) <= CLOSES:
        raise DidNotConverge(
            "the mechanism does not close at home",
            f"a pose {1e3 * shift:.2g} mm and {np.degrees(turn):.2g} deg away from it "
            "at its own readings",
            f"at most {1e3 * CLOSES * machine.size:.0e} mm and {np.degrees(CLOSES):.0e} deg",
            f"check {machine.urdf.wording.home}",
            machine.yaml_path,
        )


def reload_and_check(path: Path) -> Machine:
    """Load a mechanism after writing, and check that it closes at home.

    Loading closes the chain there; if the motors determine the pose, its readings must lead back.
    """
    machine = load_mechanism(path)
    if machine.is_determined:
        check_closes(machine)
    return machine
