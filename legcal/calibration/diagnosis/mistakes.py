"""What people do wrong, each as a change of what is taken for true: readings, model or images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import combinations

import numpy as np

from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.data import inverse
from legcal.geometry import Array
from legcal.machine import TRAVEL_MARGIN, Leg, LegKind, Machine, follow_poses, readings_at
from legcal.perception import LEFT_RIGHT, UPSIDE_DOWN

_STEP = 1.0 / 16.0  # of the way from home to readings, at least
_MIRROR = np.diag([1.0, -1.0, 1.0])
_FOCAL_LENGTHS = (2.0, 0.5, 1.5, 2.0 / 3.0, 1.25, 0.8)  # of scaled and cropped images
_SHIFTS = (1, -1, 2, -2)  # rows
_SAME_RADIUS = 1e-3  # relative: parts that are equally thick are one kind


@dataclass(frozen=True, eq=False)
class Assumed:
    """What is taken for true of a session."""

    machine: Machine
    q: Array  # (n_rows, n_legs) readings [m]
    flip: Array = field(default_factory=lambda: np.ones(2))  # -1 along axes images are turned over
    focal: float = 1.0  # focal length as a part of the stated one

    def joints(self) -> tuple[Array, Array]:
        """Return joint centres in the base link, (n_rows, n_legs, 3) each [m], NaN if not reached.

        From home the readings are followed by the equations of the legs alone.
        """
        machine, motors = self.machine, list(self.machine.motors)
        first = readings_at(machine, machine.home)[motors]
        poses, part = follow_poses(machine, machine.home, first, self.q[:, motors], _STEP)
        B = np.einsum("kij,nj->kni", poses[:, :, :3], machine.B_platform) + poses[:, None, :, 3]
        B[part < 1.0] = np.nan
        return np.broadcast_to(machine.A_base, B.shape), B

    @property
    def is_in_travel(self) -> bool:
        """Whether all readings are inside the travel of their legs, or hardly outside."""
        return all(
            _is_inside(leg, self.q[:, j])
            for j, leg in enumerate(self.machine.legs)
            if leg.kind is LegKind.ACTUATED
        )


@dataclass(frozen=True, eq=False)
class Mistake:
    """What somebody may have done wrong, and what is true then."""

    kind: str  # a word or two, for scripts
    what: str  # clause: "columns leg1_prismatic and leg2_prismatic look exchanged"
    mended: str  # "with them exchanged"
    remedy: str  # what to do
    true: Assumed
    same_as: tuple[str, ...] = ()  # clauses of what no image can tell from it


def mistakes(data: OrderedDataset) -> list[Mistake]:
    """Return what may be wrong with a session, the commoner before the rarer."""
    given = Assumed(data.machine, data.measurements.q)
    found = [
        *_of_columns(data, given),
        *_of_rows(data, given),
        *_of_encoders(given),
        *_of_images(given),
        *_of_model(data, given),
        *_of_radii(given),
        *_of_cameras(given),
    ]
    return [one for one in found if one.true.is_in_travel or not given.is_in_travel]


def _of_columns(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield readings of other legs: exchanged, reversed, from another leg on."""
    order = inverse(data.order.legs)  # legs as the files have them
    motors = [j for j in order.tolist() if given.machine.legs[j].kind is LegKind.ACTUATED]
    names = [given.machine.legs[j].prismatic for j in motors]

    def with_columns(source: Sequence[int]) -> Assumed:
        q = given.q.copy()
        q[:, motors] = given.q[:, [motors[k] for k in source]]
        return replace(given, q=q)

    n = len(motors)
    every = list(range(n))
    for i, k in combinations(every, 2):
        source = every.copy()
        source[i], source[k] = k, i
        legs = f"{given.machine.legs[motors[i]].name} and {given.machine.legs[motors[k]].name}"
        yield Mistake(
            "columns exchanged",
            f"columns {names[i]} and {names[k]} look exchanged",
            "with them exchanged",
            "exchange their headers",
            with_columns(source),
            (f"legs {legs} look exchanged in the model",),
        )
    if n > 2:
        yield Mistake(
            "columns reversed",
            "the columns of readings look as if they were in reverse order",
            "with them reversed",
            "reverse their headers",
            with_columns(every[::-1]),
            ("the legs look as if they were numbered backwards in the model",),
        )
        for k in range(1, n):
            yield Mistake(
                "columns rotated",
                f"the columns of readings look as if they began with another leg: what "
                f"{names[0]} holds is of {names[(n - k) % n]}",
                f"with them moved on by {k}",
                "correct their headers",
                with_columns([(j + k) % n for j in every]),
                ("the legs look as if they were numbered from another one on in the model",),
            )


def _of_rows(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield readings of other images: shifted by rows, views exchanged."""
    to_file = data.order.rows
    view = data.measurements.view
    n_views = len(data.measurements.views)
    # Rows of each view in the order of the file.
    of_view = [
        np.flatnonzero(view == v)[np.argsort(to_file[view == v], kind="stable")]
        for v in range(n_views)
    ]
    names = [one.name for one in data.measurements.views]
    for k in _SHIFTS:
        q = given.q.copy()
        for rows in of_view:
            q[rows] = given.q[np.roll(rows, -k)]
        if all(len(rows) > abs(k) + 1 for rows in of_view if len(rows)):
            later = f"{abs(k)} row{'s' * (abs(k) > 1)} too {'early' if k < 0 else 'late'}"
            yield Mistake(
                "readings shifted",
                f"the readings look as if they stood {later}: each image has those of another",
                f"with them moved by {abs(k)}",
                "check which image belongs to which row",
                replace(given, q=q),
            )
    for a, b in combinations(range(n_views), 2):
        if len(of_view[a]) != len(of_view[b]) or len(of_view[a]) < 2:
            continue
        q = given.q.copy()
        q[of_view[a]], q[of_view[b]] = given.q[of_view[b]], given.q[of_view[a]]
        yield Mistake(
            "views exchanged",
            f"the readings of views {names[a]} and {names[b]} look exchanged",
            "with them exchanged",
            "check which images belong to which view",
            replace(given, q=q),
        )


def _of_encoders(given: Assumed) -> Iterator[Mistake]:
    """Yield readings of another direction, zero or unit, of one encoder or of all."""
    motors = [j for j, leg in enumerate(given.machine.legs) if leg.kind is LegKind.ACTUATED]
    legs = [given.machine.legs[j] for j in motors]

    def with_readings(change: Array, which: Sequence[int]) -> Assumed:
        q = given.q.copy()
        q[:, [motors[k] for k in which]] = change
        return replace(given, q=q)

    own = given.q[:, motors]
    ends = np.array([sum(leg.travel) for leg in legs])
    ends = np.where(np.isfinite(ends), ends, own.min(axis=0) + own.max(axis=0))
    lengths = np.array([leg.sign for leg in legs]) * (own - np.array([leg.q0 for leg in legs]))
    every = list(range(len(legs)))
    for scale, unit in ((1e-3, "millimetres"), (1e-2, "centimetres"), (0.0254, "inches")):
        yield Mistake(
            "unit",
            f"the readings look like {unit}",
            "taken so",
            f"multiply them by {scale:g}",
            with_readings(scale * own, every),
        )
    yield Mistake(
        "whole lengths",
        "the readings look like whole leg lengths",
        "less the leg length at reading zero",
        "subtract that (legcal inspect shows it), or make a model whose offsets are zero",
        with_readings(lengths, every),
    )
    for change, what in ((-own, "the opposite sign"), (ends - own, "the opposite direction")):
        yield Mistake(
            "direction of encoders",
            f"the readings of all legs look as if they had {what}",
            "with it reversed",
            "reverse it in the table of readings",
            with_readings(change, every),
        )
        for k in every:
            yield Mistake(
                "direction of an encoder",
                f"column {legs[k].prismatic} looks as if it had {what}",
                "with it reversed",
                "reverse it in the table of readings",
                with_readings(change[:, k : k + 1], [k]),
            )


def _of_images(given: Assumed) -> Iterator[Mistake]:
    """Yield images that are turned over."""
    for flip, kind, what in (
        (LEFT_RIGHT, "images mirrored", "the images look mirrored"),
        (UPSIDE_DOWN, "images upside down", "the images look turned upside down"),
    ):
        yield Mistake(
            kind,
            what,
            "turned back",
            "replace them by the originals",
            replace(given, flip=flip),
        )


def _of_model(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield joints in other places: left-handed tables, platform joints of other legs."""
    machine = given.machine
    mirrored = tuple(_mirrored(leg) for leg in machine.legs)
    yield Mistake(
        "handedness",
        "the joints of the model look mirrored: the y axis of their table points the other way",
        "with the signs of y reversed",
        "reverse the signs of all y in the model",
        replace(given, machine=replace(machine, legs=mirrored)),
    )
    order = inverse(data.order.legs).tolist()
    n = len(order)
    alike = len({leg.type for leg in machine.legs}) == 1  # else other joints stand there
    for k in range(1, n) if alike else ():
        legs = list(machine.legs)
        for f, j in enumerate(order):
            other = machine.legs[order[(f + k) % n]]
            legs[j] = replace(machine.legs[j], B=other.B, platform_axis=other.platform_axis)
        name = machine.legs[order[k]].name
        yield Mistake(
            "platform joints from another leg",
            f"the platform joints of the model look as if they were listed from another leg on: "
            f"that of {machine.legs[order[0]].name} is where that of {name} stands",
            f"with them moved on by {k}",
            "correct the order of the platform joints in the model",
            replace(given, machine=replace(machine, legs=tuple(legs))),
        )


def _mirrored(leg: Leg) -> Leg:
    """Return a leg whose joints and axes have y reversed."""
    base, platform = (
        None if axis is None else _MIRROR @ axis for axis in (leg.base_axis, leg.platform_axis)
    )
    A, B = _MIRROR @ leg.A, _MIRROR @ leg.B
    return replace(leg, A=A, B=B, base_axis=base, platform_axis=platform)


def _of_radii(given: Assumed) -> Iterator[Mistake]:
    """Yield diameters in place of radii, and tubes in place of rods."""
    radii = sorted({c.radius for leg in given.machine.legs for c in leg.cylinders})
    kinds = [r for i, r in enumerate(radii) if i == 0 or r > (1.0 + _SAME_RADIUS) * radii[i - 1]]

    def scaled(factor: float, only: float | None, radius: float) -> float:
        is_own = only is None or abs(radius - only) <= _SAME_RADIUS * radius
        return factor * radius if is_own else radius

    which = [(None, "the radii"), *((r, f"the radius {1e3 * r:g} mm") for r in kinds[:2])]
    for factor, what in ((0.5, "twice as large as they are"), (2.0, "half of what they are")):
        for only, name in which[: 1 if len(kinds) < 2 else None]:
            end = what if only is None else what.replace("they are", "it is")
            yield Mistake(
                "diameter for radius",
                f"{name} of the legs in the model look{'s' * (only is not None)} {end}: a "
                f"{'diameter in place of a radius' if factor < 1.0 else 'radius halved twice'}",
                f"with {'half' if factor < 1.0 else 'twice'} of it",
                "correct the <visual> cylinders of the model",
                replace(given, machine=_with_radii(given.machine, partial(scaled, factor, only))),
            )
    if len(kinds) == 2:
        exchanged = {kinds[0]: kinds[1], kinds[1]: kinds[0]}

        def other(radius: float) -> float:
            return next(
                (new for old, new in exchanged.items() if abs(old - radius) <= _SAME_RADIUS * old),
                radius,
            )

        yield Mistake(
            "tube and rod exchanged",
            f"the radii of tube and rod look exchanged ({1e3 * kinds[0]:g} and "
            f"{1e3 * kinds[1]:g} mm)",
            "with them exchanged",
            "exchange them in the <visual> cylinders of the model",
            replace(given, machine=_with_radii(given.machine, other)),
        )


def _with_radii(machine: Machine, radius: Callable[[float], float]) -> Machine:
    """Return a machine with other radii of its visible cylinders."""
    return machine.with_cylinders(
        [[replace(c, radius=radius(c.radius)) for c in leg.cylinders] for leg in machine.legs]
    )


def _of_cameras(given: Assumed) -> Iterator[Mistake]:
    """Yield focal lengths of images that were scaled or cropped."""
    for factor in _FOCAL_LENGTHS:
        yield Mistake(
            "focal length",
            f"the focal length looks as if it were {factor:.2g} times the stated one: images "
            "that were scaled or cropped after the camera was calibrated, or another zoom",
            "with that",
            "calibrate the camera with images as these are (legcal camera)",
            replace(given, focal=factor),
        )


def _is_inside(leg: Leg, q: Array) -> bool:
    """Say whether readings of a leg are inside its travel, or hardly outside."""
    lower, upper = leg.travel
    width = upper - lower
    if not (np.isfinite(width) and width > 0.0):
        return True
    margin = TRAVEL_MARGIN * width
    inside = (q >= lower - margin) & (q <= upper + margin)
    return bool(np.all(inside | np.isnan(q)))
