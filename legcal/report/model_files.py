"""A mechanism of any format as our two files: ``models/NAME.yaml`` and ``urdf/NAME.urdf``.

The block ``legcal`` is complete in them, home included, also where it was proposed.
"""

import os
from pathlib import Path

from legcal.errors import OutOfResources, UsageError
from legcal.files.atomic import write_atomically
from legcal.geometry.frames import motion_to_xyz_quat
from legcal.mechanism.files import FOLDER_YAML
from legcal.mechanism.leg import LegKind
from legcal.mechanism.model import Mechanism
from legcal.mechanism.yaml_text import mechanism_yaml


def mechanism_text(mechanism: Mechanism, urdf: str) -> str:
    """Return the YAML of a mechanism, complete.

    Parameters
    ----------
    mechanism : Mechanism
        The mechanism, of any format.
    urdf : str
        The path of its URDF, relative to the YAML.
    """
    return mechanism_yaml(
        [(c.frame_1, c.frame_2, c.kind) for c in mechanism.chain.closures],
        [str(leg.prismatic) for leg in mechanism.legs if leg.kind is LegKind.ACTUATED],
        {
            "urdf": urdf,
            "base": mechanism.base,
            "platform": mechanism.platform,
            "platform_joint": mechanism.platform_joint,
            "base_frame": [mechanism.leg_names[j] for j in mechanism.frame_legs],
            "home": motion_to_xyz_quat(mechanism.home),
            "legs": {leg.name: _joint_of(mechanism, j) for j, leg in enumerate(mechanism.legs)},
        },
    )


def model_name(mechanism: Mechanism) -> str:
    """Return the name that the files of a mechanism get: that of its file, or of its folder."""
    path = mechanism.yaml_path
    return path.resolve().parent.name if path.name == FOLDER_YAML else path.stem


def write_model(mechanism: Mechanism, folder: Path) -> tuple[Path, Path]:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` of a mechanism.

    A URDF that was read as it stands is copied byte for byte.

    Parameters
    ----------
    mechanism : Mechanism
        The mechanism, of any format.
    folder : Path
        The folder that gets ``models`` and ``urdf``; it is made if there is none.

    Returns
    -------
    tuple of Path
        The YAML and the URDF.

    Raises
    ------
    UsageError
        If a file of either name is there already.
    OutOfResources
        If the files cannot be written.
    """
    name = model_name(mechanism)
    places = folder / "models" / f"{name}.yaml", folder / "urdf" / f"{name}.urdf"
    there = [str(path) for path in places if os.path.lexists(path)]
    if there:
        raise UsageError(
            f"{mechanism.yaml_path}: the model '{name}' could not be written: found "
            f"{' and '.join(there)} already there, needed new files; give another folder."
        )
    try:
        for path in places:
            path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(places[1], mechanism.urdf.content)
        text = mechanism_text(mechanism, f"../urdf/{name}.urdf")
        write_atomically(places[0], text.encode())  # last: a URDF alone is no model
    except OSError as error:
        raise OutOfResources(
            f"{folder}: the model could not be written: found '{error.strerror}', needed a folder "
            "that takes it; free space, correct permissions, or give another folder."
        ) from error
    return places


def _joint_of(mechanism: Mechanism, j: int) -> str:
    """Return a joint that stands for a leg: its slider, or any other on it."""
    leg, chain = mechanism.legs[j], mechanism.leg_chains[j]
    if leg.prismatic is not None:
        return leg.prismatic
    moving = [step.connection.joint for step in chain.steps if step.connection.joint]
    fixed = [joint.name for joint in mechanism.urdf.joints.values() if joint.child in chain.bodies]
    return str([*moving, *fixed][0])
