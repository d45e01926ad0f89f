"""The table of a machine: YAML or CSV, read strictly, lengths in the unit that it states."""

from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from legcal.authoring.columns import read_columns
from legcal.authoring.machine import (
    Description,
    Home,
    LegEntry,
    LegType,
    leg_type,
)
from legcal.authoring.table_schema import TableFile, is_pair
from legcal.errors import DatasetError, ModelError
from legcal.files import schema
from legcal.geometry.types import Array
from legcal.mechanism.leg import MOST_LEGS, LegKind

WHAT = "table"
UNITS = {"m": 0, "mm": -3}


def read_table(path: Path, unit: str | None = None, name: str | None = None) -> Description:
    """Return the machine that a table describes.

    Parameters
    ----------
    path : Path
        A YAML file, or a CSV file with one row for each leg.
    unit : {"m", "mm"}, optional
        The unit of all lengths, where the table does not state it.
    name : str, optional
        The name of the model, instead of the one in the YAML or the stem of the CSV.

    Raises
    ------
    ModelError
        With one sentence for each problem of the file.
    """
    try:
        if path.suffix.lower() == ".csv":
            found = read_columns(path, unit)
            found["name"] = name or found["name"]
            if not schema.is_plain_name(found["name"]) and name is None:
                raise DatasetError(
                    f"{path}: the model could not be named after the file: found "
                    f"{schema.describe(found['name'])}, needed letters, digits, '-', '_' and '.'; "
                    "give it a name with --name NAME."
                )
        else:
            found = schema.parse_yaml(schema.read_text(path, WHAT), path, WHAT)
            found = {key: value for key, value in found.items() if value is not None}
            if name is not None:
                found["name"] = name
            if unit is not None:
                found.setdefault("unit", unit)
        file = schema.validate(TableFile, found, path)
    except DatasetError as error:
        raise ModelError(error.problems) from error
    if unit is not None and unit != file.unit:
        raise ModelError(
            f"{path}: the unit could not be decided: found --unit {unit} and '{file.unit}' in the "
            "table, needed one of them; leave out --unit."
        )
    problems = _contradictions(file, str(path))
    if problems:
        raise ModelError(problems)
    description = _description(file, str(path))
    problems = _disagreements(description)
    if problems:
        raise ModelError(problems)
    return description


def in_metres(value: float, unit: str) -> float:
    """Return a length in metres: the float nearest to its decimal digits, whatever the unit."""
    return float(Decimal(repr(float(value))).scaleb(UNITS[unit]))


def _types(file: TableFile, n: int) -> list[LegType]:
    """Return the type of each leg."""
    texts = file.types or [(file.type or "").split("-")[-1]] * n
    return [found for text in texts if (found := leg_type(text)) is not None]


def _contradictions(file: TableFile, source: str) -> list[str]:
    """Return which numbers of legs and names contradict each other."""
    if (file.type is None) == (file.types is None):
        found = "both" if file.type else "neither"
        return [
            f"{source}: the legs could not be understood: found {found} of type and types, needed "
            "one: 'type: 6-UPS', or 'types' with one entry for each leg."
        ]
    n = len(file.base_joints)
    problems = []
    for key in (
        "platform_joints", "types", "legs", "offsets", "lengths", "travel", "radius", "kinds",
        "base_axes", "platform_axes",
    ):  # fmt: skip
        value = getattr(file, key)
        if isinstance(value, list) and not (key == "travel" and is_pair(value)) and len(value) != n:
            problems.append(
                f"{source}: {key} could not be used: found {len(value)} entries and {n} "
                "base_joints, needed one for each leg; correct their number."
            )
    told = (file.type or "").split("-")
    if len(told) == 2 and int(told[0]) != n:
        problems.append(
            f"{source}: type {file.type} could not be used: found {n} base_joints, needed "
            f"{int(told[0])}; correct the type or the rows."
        )
    if not 2 <= n <= MOST_LEGS:
        remedy = "add rows" if n < 2 else "leave out passive legs"
        problems.append(
            f"{source}: base_joints could not be used: found {n} {'leg' if n == 1 else 'legs'}, "
            f"needed 2 to {MOST_LEGS}; {remedy}."
        )
    names = file.legs or [f"leg{j + 1}" for j in range(n)]
    problems += [
        f"{source}: legs could not be used: found '{leg}' twice, needed unique names; rename it."
        for leg in sorted({leg for leg in names if names.count(leg) > 1})
    ]
    problems += _unused(file, source, names)
    frame = file.base_frame or []
    problems += [
        f"{source}: base_frame could not be used: found '{leg}', which is not a leg; "
        f"{schema.closest(leg, names)}"
        for leg in frame
        if leg not in names
    ]
    if len(set(frame)) != len(frame):
        problems.append(
            f"{source}: base_frame could not be used: found a leg twice, needed different legs; "
            "correct it."
        )
    if file.home and (file.home.quat_xyzw is None) == (file.home.rpy_deg is None):
        problems.append(
            f"{source}: home could not be used: needed its turn once, as quat_xyzw or as rpy_deg; "
            "write one of them."
        )
    return problems


def _unused(file: TableFile, source: str, names: list[str]) -> list[str]:
    """Return which entries are for legs that have no use for them."""
    has_slider = [leg.has_slider for leg in _types(file, len(names))]
    problems = []
    for key, of_sliders in (("lengths", False), ("offsets", True), ("travel", True)):
        value = getattr(file, key)
        shared = not isinstance(value, list) or is_pair(value)
        entries = [value] * len(names) if shared else value
        useless = [
            leg
            for leg, entry, slides in zip(names, entries, has_slider, strict=False)
            if entry is not None and slides is not of_sliders
        ]
        if useless and not (shared and len(useless) < len(names)):
            with_p, without_p = ("with", "without") if of_sliders else ("without", "with")
            problems.append(
                f"{source}: {key} could not be used: found an entry for leg '{useless[0]}', whose "
                f"type is {without_p} P, needed it for legs {with_p} P only; leave it out, or "
                "write null in a list."
            )
    return problems


def _description(file: TableFile, source: str) -> Description:
    """Return the machine of a table, its lengths in metres."""
    n = len(file.base_joints)

    def metres(value: Any) -> Any:
        if isinstance(value, list):
            return [metres(x) for x in value]
        return None if value is None else in_metres(value, file.unit)

    def per_leg(value: Any) -> list[Any]:
        return value if isinstance(value, list) else [value] * n

    names = file.legs or [f"leg{j + 1}" for j in range(n)]
    travel = [file.travel] * n if is_pair(file.travel) else per_leg(file.travel)
    legs = []
    for j, (name, kind_of_leg, kind, radius) in enumerate(
        zip(names, _types(file, n), per_leg(file.kinds), per_leg(file.radius), strict=True)
    ):
        tube, rod = _radii(radius, file.unit)
        constant = not kind_of_leg.has_slider
        default = LegKind.CONSTANT if constant else LegKind.ACTUATED
        kind = default if kind is None or constant else LegKind(kind)
        offset = per_leg(file.lengths if constant else file.offsets)[j]
        reads_length = kind is LegKind.PASSIVE and offset is None  # a pair for all means readings
        limits = metres(travel[j])
        if constant or (reads_length and is_pair(file.travel)):
            limits = None
        legs.append(
            LegEntry(
                name, kind_of_leg, kind,
                np.array(metres(file.base_joints[j])), np.array(metres(file.platform_joints[j])),
                metres(offset), None if limits is None else (limits[0], limits[1]), tube, rod,
                _unit(file.base_axes, j), _unit(file.platform_axes, j),
            )
        )  # fmt: skip
    frame = None if file.base_frame is None else tuple(file.base_frame)
    return Description(file.name, source, file.unit, tuple(legs), _home(file), frame)


def _radii(radius: Any, unit: str) -> tuple[float | None, float | None]:
    """Return the radii of tube and rod [m]."""
    both = radius if isinstance(radius, dict) else {"tube": radius, "rod": radius}
    tube, rod = (
        None if both.get(part) is None else in_metres(both[part], unit) for part in ("tube", "rod")
    )
    return tube, rod


def _unit(axes: list[Any] | None, j: int) -> Array | None:
    """Return one direction of a list, of length one."""
    if axes is None or axes[j] is None:
        return None
    axis = np.array(axes[j], dtype=float)
    return np.asarray(axis / np.linalg.norm(axis))


def _home(file: TableFile) -> Home | None:
    """Return the home of a table."""
    if file.home is None:
        return None
    xyz = tuple(in_metres(x, file.unit) for x in file.home.xyz)
    if file.home.quat_xyzw is not None:
        return Home(xyz, file.home.quat_xyzw)
    turn = Rotation.from_euler("xyz", file.home.rpy_deg or (0.0, 0.0, 0.0), degrees=True)
    return Home(xyz, tuple(float(x) for x in turn.as_quat(canonical=True)))


def _disagreements(described: Description) -> list[str]:
    """Return what legs of their types lack or cannot have."""
    problems = []
    for leg in described.legs:
        where = f"{described.source}: leg '{leg.name}' could not be used: found "
        if leg.kind is LegKind.ACTUATED and leg.offset is None:
            problems.append(
                f"{where}an actuated slider without an offset, needed its length at reading zero; "
                "add it to offsets."
            )
        if leg.kind is LegKind.ACTUATED and leg.travel is None:
            problems.append(
                f"{where}an actuated slider without travel, needed the lowest and the highest "
                "reading of its encoder; add them to travel."
            )
        if leg.kind is LegKind.CONSTANT and leg.type.has_slider:
            problems.append(
                f"{where}the kind constant with a P in its type, needed a type without P for a leg "
                "of constant length; correct kinds or types."
            )
        for side, letter, axis in (
            ("base", leg.type.base, leg.base_axis),
            ("platform", leg.type.platform, leg.platform_axis),
        ):
            if axis is not None and letter not in ("R", "U"):
                joint = f"an {letter} joint" if letter else "a leg that is fixed"
                problems.append(
                    f"{where}an axis for {joint} at the {side}, needed axes of R and U joints "
                    f"only; write null in {side}_axes."
                )
    problems += _coincident(described)
    return problems


def _coincident(described: Description) -> list[str]:
    """Return which legs begin and end in the same two points."""
    problems = []
    legs = described.legs
    for j, one in enumerate(legs):
        for two in legs[j + 1 :]:
            gap = max(
                float(np.linalg.norm(one.A_base - two.A_base)),
                float(np.linalg.norm(one.B_platform - two.B_platform)),
            )
            if gap < 1e-6:
                problems.append(
                    f"{described.source}: legs '{one.name}' and '{two.name}' could not be used: "
                    "found both between the same two points, needed different joints; correct "
                    "their rows."
                )
    if any(float(np.ptp([getattr(leg, s) for leg in legs], axis=0).max()) < 1e-6 for s in
           ("A_base", "B_platform")):  # fmt: skip
        problems.append(
            f"{described.source}: the joints could not be used: found all of one side in one "
            "point, needed them spread out; correct base_joints or platform_joints."
        )
    return problems
