"""What a table may say, value by value: the schema of its keys."""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BeforeValidator, Field

from legcal.authoring.machine import NEEDED_TYPE, leg_type
from legcal.files import schema
from legcal.files.motion import Quaternion, Vector
from legcal.mechanism.leg import LegKind

LARGEST = 1e9  # of any number, whatever its unit


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < LARGEST


def _wanted(value: Any, fits: bool, needed: str) -> Any:
    """Return a value if it fits, else refuse it."""
    if not fits:
        raise ValueError(f"found {schema.describe(value)}, needed {needed}; correct it.")
    return value


def _numbers(value: Any) -> Any:
    entries = value if isinstance(value, list) else [value]
    return _wanted(
        value,
        all(_number(x) or (x is None and isinstance(value, list)) for x in entries),
        f"a number below {LARGEST:g}, or a list with a number (or null) for each leg",
    )


def is_pair(value: object) -> bool:
    """Say whether a value is one pair of readings."""
    return isinstance(value, list) and len(value) == 2 and all(_number(x) for x in value)


def _travel(value: Any) -> Any:
    fits = is_pair(value) or (
        isinstance(value, list) and all(x is None or is_pair(x) for x in value)
    )
    _wanted(value, fits, "[lowest, highest] reading, or a list with that pair (or null) a leg")
    for pair in [value] if is_pair(value) or not isinstance(value, list) else value:
        if pair is not None and not pair[0] < pair[1]:
            raise ValueError(f"found {pair}, needed the lower reading first; correct it.")
    return value


def _is_radius(value: Any) -> bool:
    if isinstance(value, dict):
        return (
            bool(value)
            and value.keys() <= {"tube", "rod"}
            and all(_number(x) and x > 0 for x in value.values())
        )
    return _number(value) and value > 0


def _radius(value: Any) -> Any:
    entries = value if isinstance(value, list) else [value]
    return _wanted(
        value,
        all(_is_radius(x) or (x is None and isinstance(value, list)) for x in entries),
        "a positive number, {tube: ..., rod: ...}, or a list with one of these (or null) a leg",
    )


def _points(value: Any) -> Any:
    rows = value if isinstance(value, list) else [value]
    for i, row in enumerate(rows):
        fits = isinstance(row, list) and len(row) in (2, 3) and all(_number(x) for x in row)
        if not fits:
            raise ValueError(
                f"found {schema.describe(row)} in row {i + 1}, needed three numbers below "
                f"{LARGEST:g}, x y z (two in the plane); correct it."
            )
    return [[*row, 0.0][:3] for row in rows]


def _directions(value: Any) -> Any:
    rows = value if isinstance(value, list) else [value]
    for i, row in enumerate(rows):
        fits = row is None or (
            isinstance(row, list)
            and len(row) == 3
            and all(_number(x) for x in row)
            and float(np.linalg.norm(row)) > 1e-6
        )
        if not fits:
            raise ValueError(
                f"found {schema.describe(row)} in row {i + 1}, needed a direction of three numbers "
                "that are not all zero, or null for the default; correct it."
            )
    return rows


def _kinds(value: Any) -> Any:
    entries = value if isinstance(value, list) else [value]
    known = [kind.value for kind in LegKind]
    for kind in entries:
        if kind is not None and kind not in known:
            raise ValueError(
                f"found {schema.describe(kind)}, needed {', '.join(known)}, one for all legs or a "
                "list; correct it."
            )
    return value


def _type_of_leg(value: object) -> object:
    if not isinstance(value, str) or leg_type(value) is None:
        raise ValueError(
            f"found the leg type {schema.describe(value)}, needed {NEEDED_TYPE}; correct it."
        )
    return value


def _type(value: object) -> object:
    number, _, leg = value.rpartition("-") if isinstance(value, str) else ("", "", "")
    counts = number.isascii() and number.isdigit() and len(number) < 10 and int(number) > 0
    if not leg or (not counts and value != leg):
        raise ValueError(
            f"found {schema.describe(value)}, needed a type such as 6-UPS; correct it."
        )
    _type_of_leg(leg)
    return value


Points = Annotated[list[Any], BeforeValidator(_points)]
Directions = Annotated[list[Any], BeforeValidator(_directions)]


class HomeEntry(schema.FileSchema):
    """The block ``home``: a pose of the platform in the base."""

    xyz: Vector
    quat_xyzw: Quaternion | None = None
    rpy_deg: Vector | None = None


class TableFile(schema.FileSchema):
    """A table in YAML. All lengths are in ``unit``; directions have no length."""

    legcal_table: schema.Version
    name: schema.PlainName
    unit: Literal["m", "mm"]
    type: Annotated[str | None, BeforeValidator(_type)] = None
    types: list[Annotated[str, BeforeValidator(_type_of_leg)]] | None = None
    legs: list[schema.PlainName] | None = None
    base_joints: Points
    platform_joints: Points
    offsets: Annotated[Any, BeforeValidator(_numbers)] = None
    lengths: Annotated[Any, BeforeValidator(_numbers)] = None
    travel: Annotated[Any, BeforeValidator(_travel)] = None
    radius: Annotated[Any, BeforeValidator(_radius)] = None
    kinds: Annotated[Any, BeforeValidator(_kinds)] = None
    base_axes: Directions | None = None
    platform_axes: Directions | None = None
    home: HomeEntry | None = None
    base_frame: Annotated[list[str], Field(min_length=2, max_length=3)] | None = None
