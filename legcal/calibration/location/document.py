"""World and tool in the URDF: two links, held by fixed joints; every other byte stays.

A ``world`` link above the root carries the machine, a ``tool`` link hangs on the platform. Where
they are there already, as an earlier location leaves them, their origins are changed.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import BeforeValidator, Field
from scipy.spatial.transform import RigidTransform

from legcal.calibration.location.model import (
    NAMES,
    Location,
    MeasurementNoise,
    OpenPart,
    RowResidual,
)
from legcal.errors import DatasetError, ModelError, UsageError
from legcal.files import (
    FileSchema,
    MotionEntry,
    Number,
    OwnYaml,
    Version,
    existing_parent,
    is_plain_name,
    motion_to_xyz_quat,
    parse_yaml,
    read_text,
    temporary_folder,
    validate,
)
from legcal.geometry import roll_pitch_yaw
from legcal.machine import Mechanism, Urdf, UrdfPatch, load_mechanism, write_model

WHAT = "location file"
KEY = "legcal_location"
LOCATION_FILE = OwnYaml("the location", WHAT, KEY, "a new file or an earlier location")
_SYMMETRIC = 1e-9  # relative
_NONE = 1e-12  # below zero: rounding

_Vector = Annotated[
    tuple[Number, Number, Number], BeforeValidator(lambda v: tuple(v) if type(v) is list else v)
]
_Size = Annotated[Number, Field(ge=0.0)]


class _Frame(MotionEntry):
    """A frame with its standard deviations, which the covariance repeats in full."""

    sigma_xyz: _Vector
    sigma_rotation: _Vector | None


class _Held(FileSchema):
    """A part that the machine leaves open."""

    frame: Literal["base", "tool"]
    kind: Literal["position", "orientation"]
    directions: Annotated[list[_Vector], Field(min_length=1, max_length=3)]


class _Determined(FileSchema):
    """What is determined and what was held."""

    everything: bool
    tool_orientation: bool
    held: list[_Held]
    tool_position: _Vector
    words: str


class _Noise(FileSchema):
    """How precise the measured poses are."""

    position: _Size
    angle: _Size | None
    position_stated: bool
    angle_stated: bool
    reading: _Size
    model: bool


class _Row(FileSchema):
    """Residuals of a row."""

    row: Annotated[int, Field(ge=1)]
    position: _Vector
    rotation: _Vector | None
    left_out: str


class _Residuals(FileSchema):
    """What is left of the measured poses."""

    chi2: _Size
    dof: Annotated[int, Field(ge=0)]
    p_value: _Size | None
    rms_position: _Size
    rms_angle: _Size | None
    rows: Annotated[list[_Row], Field(min_length=1)]


class _Tool(FileSchema):
    """How well the frames put the tool in the world."""

    position: _Size
    angle: _Size | None


class _Covariance(FileSchema):
    """The covariance of both frames."""

    names: list[str]
    matrix: list[list[Number]]


class _Document(FileSchema):
    """The file."""

    legcal_location: Version
    status: Literal["located", "located in part", "doubtful"]
    verdict: str
    model: str
    poses: str
    T_world_base: _Frame
    T_platform_tool: _Frame
    determined: _Determined
    noise: _Noise
    tool_in_world_sigma: _Tool
    residuals: _Residuals
    covariance: _Covariance
    notes: list[str]


def location_document(location: Location) -> dict[str, Any]:
    """Return a location as its file has it."""
    sigma = [[float(s) for s in part] for part in location.sigma.reshape(4, 3)]
    base, tool = (
        dict[str, Any](motion_to_xyz_quat(T))
        | {"sigma_xyz": sigma[i], "sigma_rotation": sigma[i + 1]}
        for i, T in ((0, location.T_world_base), (2, location.T_platform_tool))
    )
    if not location.has_tool_orientation:
        tool["sigma_rotation"] = None
    return {
        KEY: 1,
        "status": location.status,
        "verdict": location.sentence,
        "model": location.model,
        "poses": location.poses,
        "T_world_base": base,
        "T_platform_tool": tool,
        "determined": {
            "everything": not location.held,
            "tool_orientation": location.has_tool_orientation,
            "held": [
                {"frame": h.frame, "kind": h.kind, "directions": [list(v) for v in h.directions]}
                for h in location.held
            ],
            "tool_position": list(location.held_at),
            "words": location.held_words,
        },
        "noise": vars(location.noise).copy(),
        "tool_in_world_sigma": {
            "position": location.tool_position_sigma,
            "angle": location.tool_angle_sigma,
        },
        "residuals": {
            "chi2": location.chi2,
            "dof": location.dof,
            "p_value": location.p_value,
            "rms_position": location.rms_position,
            "rms_angle": location.rms_angle,
            "rows": [
                {
                    "row": row.row,
                    "position": list(row.position),
                    "rotation": None if row.rotation is None else list(row.rotation),
                    "left_out": row.reason,
                }
                for row in location.rows
            ],
        },
        "covariance": {"names": list(NAMES), "matrix": location.covariance.tolist()},
        "notes": list(location.notes),
    }


def write_location(location: Location, file: str | Path) -> None:
    """Write a location; an earlier one is replaced, any other file is not.

    Parameters
    ----------
    location : Location
        What was located.
    file : str or Path
        The YAML.

    Raises
    ------
    UsageError
        If another file stands there, or none can be written.
    OutOfResources
        If the file cannot be written.
    """
    text = yaml.safe_dump(
        location_document(location),
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=120,
    )
    LOCATION_FILE.write(Path(file), text)


def load_location(file: str | Path) -> Location:
    """Return the location in a file that ``legcal locate`` wrote.

    Parameters
    ----------
    file : str or Path
        The YAML.

    Raises
    ------
    DatasetError
        If it is missing or damaged.
    """
    path = Path(file)
    found = parse_yaml(read_text(path, WHAT), path, WHAT)
    if KEY not in found:
        raise DatasetError(
            f"{path}: the {WHAT} could not be read: found no key '{KEY}', needed a file that "
            "legcal locate wrote; give that file."
        )
    document = validate(_Document, found, path)
    determined, residuals = document.determined, document.residuals
    return Location(
        model=document.model,
        poses=document.poses,
        T_world_base=document.T_world_base.motion(),
        T_platform_tool=document.T_platform_tool.motion(),
        has_tool_orientation=determined.tool_orientation,
        covariance=_matrix(path, document.covariance),
        held=tuple(OpenPart(h.frame, h.kind, tuple(h.directions)) for h in determined.held),
        held_at=determined.tool_position,
        held_words=determined.words,
        noise=MeasurementNoise(**document.noise.model_dump()),
        rows=tuple(RowResidual(r.row, r.position, r.rotation, r.left_out) for r in residuals.rows),
        chi2=residuals.chi2,
        dof=residuals.dof,
        p_value=residuals.p_value,
        tool_position_sigma=document.tool_in_world_sigma.position,
        tool_angle_sigma=document.tool_in_world_sigma.angle,
        status=document.status,
        sentence=document.verdict,
        notes=tuple(document.notes),
    )


def _matrix(path: Path, found: _Covariance) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the covariance, refused where it is none."""
    n = len(NAMES)
    is_square = len(found.matrix) == n and all(len(row) == n for row in found.matrix)
    if tuple(found.names) == NAMES and is_square:
        matrix = np.array(found.matrix)
        largest = float(np.abs(matrix).max())
        symmetric = np.abs(matrix - matrix.T).max() <= _SYMMETRIC * largest
        if symmetric and float(np.linalg.eigvalsh(matrix)[0]) >= -_NONE * largest:
            return matrix
    raise DatasetError(
        f"{path}: covariance could not be read: found another matrix, needed a covariance of the "
        f"{n} components {NAMES[0]} to {NAMES[-1]}; give the file that legcal locate wrote."
    )


WORLD, TOOL = "world", "tool"
_SAME = 1e-12  # [m, rad]: rounding of the analysis


def write_located_model(
    mechanism: Mechanism,
    location: Location,
    folder: Path,
    *,
    world: str = WORLD,
    tool: str = TOOL,
) -> tuple[Path, Path]:
    """Write ``models/NAME.yaml`` and ``urdf/NAME.urdf`` with the located frames in the URDF.

    Parameters
    ----------
    mechanism : Mechanism
        The machine that was located.
    location : Location
        Its frames.
    folder : Path
        Gets ``models`` and ``urdf``; nothing there is replaced.
    world, tool : str
        The links.

    Returns
    -------
    tuple of Path
        The YAML and the URDF.

    Raises
    ------
    UsageError
        If files of these names are there, or the links have another meaning in the URDF.
    ModelError
        If the URDF does not let a link carry the machine.
    """
    content = with_frames(mechanism, location, world=world, tool=tool)
    located = replace(mechanism, urdf=replace(mechanism.urdf, content=content))
    with temporary_folder(existing_parent(folder / "x"), "located") as temporary:
        written, _ = write_model(located, temporary)
        check_same(mechanism, load_mechanism(written))
    return write_model(located, folder)


def with_frames(
    mechanism: Mechanism, location: Location, *, world: str = WORLD, tool: str = TOOL
) -> bytes:
    """Return the URDF of a mechanism with the located frames in it."""
    for name in (world, tool):
        if not is_plain_name(name):
            raise UsageError(
                f"The frames could not be written: found the link name {name!r}, needed letters, "
                "digits, '-', '_' and '.'; give another one."
            )
    if world == tool:
        raise UsageError(
            f"The frames could not be written: found '{world}' for world and tool, needed two "
            "names; give another one."
        )
    urdf = mechanism.urdf
    T_root_base = _from_root(urdf, mechanism.base)
    patch = UrdfPatch(urdf.content)

    def place(joint: str, T: RigidTransform) -> None:
        patch.set_origin(joint, np.asarray(T.translation), roll_pitch_yaw(T.rotation.as_matrix()))

    if world in urdf.links:
        joint = _joint_of_world(mechanism, world)
        T_child_base = urdf.joints[joint].T_parent_origin.inv() * T_root_base
        place(joint, location.T_world_base * T_child_base.inv())
    else:
        T_world_root = location.T_world_base * T_root_base.inv()
        patch.add_frame(
            world, urdf.root, world, _unused_joint(urdf, world, urdf.root), T_world_root
        )
    if tool in urdf.links:
        place(_joint_of_tool(mechanism, tool), location.T_platform_tool)
    else:
        joint = _unused_joint(urdf, mechanism.platform, tool)
        patch.add_frame(mechanism.platform, tool, tool, joint, location.T_platform_tool)
    return patch.content()


def _from_root(urdf: Urdf, base: str) -> RigidTransform:
    """Return T_root_base, refused where a joint between them moves."""
    above = {joint.child: joint for joint in urdf.joints.values()}
    T, link = RigidTransform.identity(), base
    while link != urdf.root:
        joint = above[link]
        if joint.moves:
            raise ModelError(
                f"{urdf.path}: the world could not be written: found the base '{base}' below the "
                f"joint '{joint.name}', which moves, needed fixed joints between it and the root "
                f"'{urdf.root}'; hang the platform from the base."
            )
        T, link = joint.T_parent_origin * T, joint.parent
    return T


def _joint_of_world(mechanism: Mechanism, world: str) -> str:
    """Return the fixed joint below a world link that carries all the rest."""
    urdf = mechanism.urdf
    below = [joint for joint in urdf.joints.values() if joint.parent == world]
    if world == urdf.root != mechanism.base and len(below) == 1 and not below[0].moves:
        return below[0].name
    raise UsageError(
        f"{urdf.path}: the world could not be written: found a link '{world}' that is not a root "
        "with the machine on one fixed joint below it, needed such a link or a free name; give "
        "another name (--world-link)."
    )


def _joint_of_tool(mechanism: Mechanism, tool: str) -> str:
    """Return the fixed joint between the platform and a tool link that carries nothing."""
    urdf = mechanism.urdf
    joint = next((joint for joint in urdf.joints.values() if joint.child == tool), None)
    frames = {name for c in mechanism.chain.closures for name in (c.frame_1, c.frame_2)}
    carries = any(other.parent == tool for other in urdf.joints.values())
    if (
        joint is not None
        and not joint.moves
        and joint.parent == mechanism.platform
        and not carries
        and frames.isdisjoint((tool, joint.name))
    ):
        return joint.name
    raise UsageError(
        f"{urdf.path}: the tool could not be written: found a link '{tool}' that is not at the end "
        f"of a fixed joint on the platform '{mechanism.platform}', needed such a link or a free "
        "name; give another name (--tool-link)."
    )


def _unused_joint(urdf: Urdf, parent: str, child: str) -> str:
    """Return a free name of a fixed joint between two links."""
    joint = f"{parent}_{child}_frame"
    while joint in urdf.links or joint in urdf.joints:
        joint += "_"
    return joint


def check_same(before: Mechanism, after: Mechanism) -> None:
    """Check that a model with frames is the same machine.

    Raises
    ------
    ModelError
        If its analysis differs by more than rounding.
    """
    same = (
        before.leg_names == after.leg_names
        and before.motors == after.motors
        and before.mobility == after.mobility
        and before.frame_legs == after.frame_legs
        and all(
            np.abs(one - other).max() <= _SAME
            for one, other in (
                (before.A_base, after.A_base),
                (before.B_platform, after.B_platform),
                (before.q0, after.q0),
                (before.home.as_matrix(), after.home.as_matrix()),
            )
        )
    )
    if not same:
        raise ModelError(
            f"{before.urdf_path}: the frames could not be written: found another machine after "
            "it, needed the same one; give other names (--world-link, --tool-link)."
        )
