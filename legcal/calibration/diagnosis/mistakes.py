"""Common mistakes, each as a changed hypothesis on readings, model or images."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.data.image_tables import inverse
from legcal.data.measurements import few, row_names
from legcal.geometry.types import Array, IntArray
from legcal.machine.kinematics import follow_poses
from legcal.machine.leg import Leg
from legcal.machine.model import Machine, readings_at
from legcal.perception.camera_search import LEFT_RIGHT, UPSIDE_DOWN

_STEP = 1.0 / 16.0  # of the way from home to readings, at least
_MIRROR = np.diag([1.0, -1.0, 1.0])
_MIRROR_4 = np.diag([1.0, -1.0, 1.0, 1.0])
_FOCAL_LENGTHS = (2.0, 0.5, 1.5, 2.0 / 3.0, 1.25, 0.8)  # of scaled and cropped images
_FOCAL_STEP = 1.25  # between them, about
_LATE = {1: "late", -1: "early"}  # by how many rows readings are moved back
_ZEROS = 8  # steps of the zero of an encoder, in its travel
_STILL = 0.1  # of such a step: readings that move by less are of an encoder that stands still
_SAME_END = 0.01  # of the largest reading: ends of a travel as far from zero
_SAME_RADIUS = 1e-3  # relative: parts that are equally thick are one kind


TURNS = LEFT_RIGHT, UPSIDE_DOWN
_TURNS_IN_WORDS = (
    ("images mirrored", "mirrored"),
    ("images upside down", "turned upside down"),
)
_MOVE_ONE = "move one leg alone and see which column changes, and which leg moves in a photograph"
_LETTERING = "look at lettering in a photograph"


@dataclass(frozen=True, eq=False)
class Assumed:
    """A hypothesis on a session: readings, model, orientation of images, camera positions."""

    machine: Machine
    q: Array  # (n_rows, n_legs) readings [m or rad]
    flip: Array  # (n_rows, 2) -1 along axes that images are turned over
    place: IntArray  # (n_rows,) number of the camera position within a view, from 0
    focal: float = 1.0  # focal length over the stated one

    def joints(self, rows: Sequence[int]) -> tuple[Array, Array]:
        """Return joint centres in the base link, as :func:`joints_of`."""
        return joints_of([(self, rows)])[0]

    def is_as(self, other: Assumed, rows: Sequence[int]) -> bool:
        """Whether nothing differs from another in some rows."""
        return (
            self.machine is other.machine
            and self.focal == other.focal
            and np.array_equal(self.q[rows], other.q[rows], equal_nan=True)
            and np.array_equal(self.flip[rows], other.flip[rows])
            and np.array_equal(self.place[rows], other.place[rows])
        )

    @property
    def is_in_travel(self) -> bool:
        """Whether all readings are inside the travel of their legs, or hardly outside."""
        return all(
            bool(leg.in_travel(self.q[:, j]).all())
            for j, leg in enumerate(self.machine.legs)
            if leg.is_motor
        )


@dataclass(frozen=True, eq=False)
class Mistake:
    """A possible mistake, and the hypothesis that corrects it."""

    kind: str  # a word or two, for scripts
    what: str  # clause: "columns leg1_prismatic and leg2_prismatic appear to be swapped"
    mended: str  # "with the columns swapped"
    remedy: str  # what to do
    true: Assumed
    same_as: tuple[str, ...] = ()  # clauses of mistakes that no image can distinguish from it
    test: str = ""  # how to decide between them: "move one leg alone and ..."
    is_small: bool = False  # cameras are about where images put them without correction
    of_few: tuple[int, ...] = ()  # rows, if only single images are affected
    amount_of: str = ""  # mistakes of one name differ in amount: only the best is reported
    # The same mistake by a finer amount, in steps; None where it has no amount.
    finer: Callable[[float], Mistake] | None = None
    # The opposite mistake: if this one fits better than no correction, its opposite fits worse.
    # None where the opposite may fit as well.
    opposite: Assumed | None = None


def joints_of(parts: Sequence[tuple[Assumed, Sequence[int]]]) -> list[tuple[Array, Array]]:
    """Return joint centres of some rows under each of many hypotheses, in the base link [m].

    Those at A and at B, (n_rows, n_legs, 3) each. From home the readings are followed by the
    equations of the legs alone, those of one machine all together; what is not reached, and all
    other rows, are NaN.
    """
    found = list[tuple[Array, Array]]()
    for one, _ in parts:
        shape = (len(one.q), one.machine.n_legs, 3)
        found.append((np.full(shape, np.nan), np.full(shape, np.nan)))
    for machine in {id(one.machine): one.machine for one, _ in parts}.values():
        own = [k for k, (one, _) in enumerate(parts) if one.machine is machine]
        rows = [np.array(parts[k][1], dtype=np.intp) for k in own]
        q = np.concatenate([parts[k][0].q[some] for k, some in zip(own, rows, strict=True)])
        motors, ends = list(machine.motors), np.cumsum([len(some) for some in rows])
        first = readings_at(machine, machine.home)[motors]
        poses, part = follow_poses(machine, machine.home, first, q[:, motors], _STEP)
        B = np.einsum("kij,nj->kni", poses[:, :, :3], machine.B_platform)
        B += poses[:, None, :, 3]
        B[part < 1.0] = np.nan
        A = machine.A_at(q[:, list(machine.reads)])
        for k, some, A_of, B_of in zip(
            own, rows, np.split(A, ends[:-1]), np.split(B, ends[:-1]), strict=True
        ):
            found[k][0][some], found[k][1][some] = A_of, B_of
    return found


def as_given(data: OrderedDataset) -> Assumed:
    """Return the hypothesis that the files are right."""
    n = data.measurements.n_rows
    return Assumed(data.machine, data.measurements.q, np.ones((n, 2)), np.zeros(n, dtype=np.intp))


def both(one: Mistake, other: Mistake, beside: Sequence[Mistake] = ()) -> Mistake:
    """Return two mistakes at once: the other was found with the first one corrected.

    ``beside`` are mistakes that images cannot distinguish from the first, one of each kind.
    """
    alike = [same.what for same in beside if same.kind != one.kind]
    return Mistake(
        f"{one.kind} and {other.kind}",
        f"{one.what}, and {other.what}",
        f"{one.mended} and {other.mended}",
        f"{one.remedy}, and {other.remedy}",
        other.true,
        (*one.same_as, *alike, *other.same_as),
        one.test or other.test,
    )


def mistakes(data: OrderedDataset, given: Assumed | None = None) -> list[Mistake]:
    """Return the possible mistakes of a session, the commoner before the rarer.

    They are changes of the hypothesis ``given``, by default that the files are right.
    """
    given = given or as_given(data)
    encoders = _Encoders(given)
    found = [
        *_of_columns(data, given),
        *_of_rows(data, given),
        *_of_units(encoders),
        *_of_directions(encoders),
        *_of_zeros(encoders),
        *_of_images(data, given),
        *_of_model(given),
        *_of_radii(given),
        *_of_cameras(given),
    ]
    return [one for one in found if one.true.is_in_travel or not given.is_in_travel]


def _of_columns(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield readings of other legs: columns swapped, reversed, or rotated."""
    order = inverse(data.order.legs)  # legs as the files have them
    motors = [j for j in order.tolist() if j in given.machine.motors]
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
        ones = [given.machine.legs[motors[i]], given.machine.legs[motors[k]]]
        legs = " and ".join(leg.motor_label for leg in ones)
        what = "motors" if all(leg.actuator for leg in ones) else "legs"
        yield Mistake(
            "columns exchanged",
            f"columns {names[i]} and {names[k]} appear to be swapped",
            "with the columns swapped",
            "swap the headers of these columns",
            with_columns(source),
            (f"{what} {legs} appear to be swapped in the model",),
            _MOVE_ONE,
        )
    if n > 3:  # of three these are two exchanged
        yield Mistake(
            "columns reversed",
            "the reading columns appear to be in reverse order",
            "with the columns reversed",
            "reverse the headers of the columns",
            with_columns(every[::-1]),
            ("the legs appear to be numbered in reverse order in the model",),
            _MOVE_ONE,
        )
    for k in range(1, n) if n > 2 else ():
        yield Mistake(
            "columns rotated",
            f"the reading columns appear to be shifted: column {names[0]} contains the readings "
            f"of {names[(n - k) % n]}",
            f"with the columns shifted by {k}",
            "correct the headers of the columns",
            with_columns([(j + k) % n for j in every]),
            ("the legs appear to be numbered from another starting leg in the model",),
            _MOVE_ONE,
        )


def shifted_from(data: OrderedDataset, given: Assumed, v: int, first: int, k: int) -> Mistake:
    """Return readings of a view that are a row late (k = 1) or early (-1) from its row *first* on.

    Rows count in the order of the file. The last row, whose readings are unknown, keeps its own.
    """
    rows = rows_of_views(data)[v][first:]
    q = given.q.copy()
    q[rows[:-k] if k > 0 else rows[-k:]] = given.q[rows[k:] if k > 0 else rows[:k]]
    name, row = data.measurements.views[v].name, data.order.rows[rows[0]]
    where = row_names(data.dataset.measurements)[row]
    return Mistake(
        "readings shifted",
        f"from {where} on, the readings of view {name} appear to be 1 row too {_LATE[k]}; "
        f"{'an image' if k > 0 else 'a row of readings'} may be missing there",
        "with the readings shifted by 1 row",
        "check which image belongs to which row",
        replace(given, q=q),
        amount_of=f"rows of view {name}",
    )


def rows_of_views(data: OrderedDataset) -> list[IntArray]:
    """Return the rows of each view in the order of the file."""
    view, to_file = data.measurements.view, data.order.rows
    return [
        np.flatnonzero(view == v)[np.argsort(to_file[view == v], kind="stable")]
        for v in range(len(data.measurements.views))
    ]


def _of_rows(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield readings of other images: shifted by a row, in all views or in one."""
    of_view = rows_of_views(data)
    names = [one.name for one in data.measurements.views]
    every = [rows for rows in of_view if len(rows)]

    def moved(which: Sequence[IntArray], k: int, view: str = "") -> Iterator[Mistake]:
        if any(len(rows) <= 2 for rows in which):
            return
        q = given.q.copy()
        for rows in which:
            q[rows] = given.q[np.roll(rows, -k)]
        where = f" of view {view}" if view else ""
        yield Mistake(
            "readings shifted",
            f"the readings{where} appear to be 1 row too {_LATE[k]}: each image is paired with "
            "the readings of its neighbour",
            "with the readings shifted by 1 row",
            "check which image belongs to which row",
            replace(given, q=q),
            amount_of=f"rows{where}",
        )

    for k in _LATE:
        yield from moved(every, k)
    for v, rows in enumerate(of_view):
        if len(every) > 1:
            for k in _LATE:
                yield from moved([rows], k, names[v])


@dataclass(frozen=True, eq=False)
class _Encoders:
    """The encoders of a session, their readings, and their names in messages."""

    given: Assumed

    @cached_property
    def legs(self) -> list[Leg]:
        """The leg that each encoder reads, or the first leg that its motor moves."""
        return [self.given.machine.legs[j] for j in self.given.machine.motors]

    @property
    def names(self) -> list[str]:
        """Their columns in the table of readings."""
        return [str(leg.prismatic) for leg in self.legs]

    @property
    def every(self) -> list[int]:
        """All of them."""
        return list(range(len(self.legs)))

    @cached_property
    def q(self) -> Array:
        """Readings (n_rows, n_encoders) [m or rad]."""
        return self.given.q[:, list(self.given.machine.motors)]

    @property
    def move_legs_alone(self) -> bool:
        """Whether each reads the length of a leg."""
        return not any(leg.actuator for leg in self.legs)

    @property
    def turning(self) -> list[int]:
        """Indices of encoders that read angles."""
        return [k for k, leg in enumerate(self.legs) if leg.reads_angle]

    @cached_property
    def zero_steps(self) -> Array:
        """Step by which zeros are varied (n_encoders,) [m or rad]."""
        width = np.array([leg.travel[1] - leg.travel[0] for leg in self.legs])
        is_known = (width > 0.0) & np.isfinite(width)
        return np.where(is_known, width, np.ptp(self.q, axis=0)) / _ZEROS

    @property
    def moving(self) -> list[int]:
        """Indices of encoders that move: images can confirm their direction and their zero."""
        return np.flatnonzero(np.ptp(self.q, axis=0) > _STILL * self.zero_steps).tolist()

    @property
    def in_words(self) -> str:
        """``legs`` or ``motors``, for messages."""
        return "legs" if self.move_legs_alone else "motors"

    def reading(self, q: Array, which: Sequence[int]) -> Assumed:
        """Return the hypothesis that some encoders had other readings (n_rows, n_some)."""
        motors, changed = self.given.machine.motors, self.given.q.copy()
        changed[:, [motors[k] for k in which]] = q
        return replace(self.given, q=changed)


def _of_units(encoders: _Encoders) -> Iterator[Mistake]:
    """Yield angles in another unit; lengths in another one are outside the travel and refused."""
    turning = encoders.turning
    of = (
        ""
        if len(turning) == len(encoders.legs)
        else f" of {few([encoders.names[k] for k in turning])}"
    )
    angles = (np.pi / 180.0, "degrees"), (180.0 / np.pi, "radians that were taken for degrees")
    for scale, unit in angles if turning else ():
        yield Mistake(
            "unit",
            f"the readings{of} look like {unit}",
            "interpreted that way",
            f"multiply these readings by {scale:g}",
            encoders.reading(scale * encoders.q[:, turning], turning),
        )


def _of_directions(encoders: _Encoders) -> Iterator[Mistake]:
    """Yield readings of the other direction, of one encoder or of all."""
    q = encoders.q
    ends = np.array([sum(leg.travel) for leg in encoders.legs])
    ends = np.where(np.isfinite(ends), ends, q.min(axis=0) + q.max(axis=0))
    # Where a travel is as far both ways, as of most servos, the other end has the opposite sign.
    reversible = np.abs(ends) > _SAME_END * np.abs(q).max(axis=0)
    for reversed_q, what, which in (
        (-q, "the opposite sign", encoders.every),
        (ends - q, "the opposite direction", np.flatnonzero(reversible).tolist()),
    ):
        if which:
            yield Mistake(
                "direction of encoders",
                f"the readings of all {encoders.in_words} appear to have {what}",
                "with the readings reversed",
                "reverse them in the table of readings",
                encoders.reading(reversed_q, encoders.every),
            )
        for k in (k for k in encoders.moving if k in which):
            yield Mistake(
                "direction of an encoder",
                f"column {encoders.names[k]} appears to have {what}",
                "with the column reversed",
                "reverse the column in the table of readings",
                encoders.reading(reversed_q[:, k : k + 1], [k]),
            )


def _of_zeros(encoders: _Encoders) -> Iterator[Mistake]:
    """Yield wrong zeros of one encoder or of all."""
    are_alike = len(encoders.turning) in (0, len(encoders.legs))  # else no zero is common
    for m in (*range(-_ZEROS, 0), *range(1, _ZEROS + 1)):
        if are_alike:
            yield _zero_of_all(encoders, m)
        for k in encoders.moving:
            yield _zero_of_one(encoders, k, m)


def _zero_of_all(encoders: _Encoders, m: float) -> Mistake:
    """Return a wrong zero of all encoders, by m steps."""
    step, is_angle = float(encoders.zero_steps.mean()), bool(encoders.turning)
    zeros = "the offsets" if encoders.move_legs_alone else "the zeros of motors"
    return Mistake(
        "zero of encoders",
        f"the readings of all {encoders.in_words} appear to have a wrong zero: about "
        f"{_too_small(m, step, is_angle=is_angle)}",
        _with_that(m),
        f"correct the table of readings, or {zeros} in the model",
        encoders.reading(encoders.q + m * step, encoders.every),
        is_small=True,
        amount_of="zero of all encoders",
        finer=lambda more: _zero_of_all(encoders, m + more),
    )


def _zero_of_one(encoders: _Encoders, k: int, m: float) -> Mistake:
    """Return a wrong zero of the k-th encoder, by m steps."""
    step, name = float(encoders.zero_steps[k]), encoders.names[k]
    zero = f"the zero of {name}" if encoders.legs[k].actuator else "the offset of the leg"
    return Mistake(
        "zero of an encoder",
        f"column {name} appears to have a wrong zero: about "
        f"{_too_small(m, step, is_angle=k in encoders.turning)}",
        _with_that(m),
        f"correct the column in the table of readings, or {zero} in the model",
        encoders.reading(encoders.q[:, [k]] + m * step, [k]),
        is_small=True,
        amount_of=f"zero of encoder {k}",
        finer=lambda more: _zero_of_one(encoders, k, m + more),
    )


def _too_small(m: float, step: float, *, is_angle: bool) -> str:
    """Return the error of readings that lack m steps [m or rad], in words."""
    amount, unit = (np.degrees(step), "deg") if is_angle else (1e3 * step, "mm")
    return f"{abs(m * amount):.0f} {unit} too {'small' if m > 0 else 'large'}"


def _with_that(m: float) -> str:
    return f"after {'adding' if m > 0 else 'subtracting'} it"


def _of_images(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield images that are mirrored or upside down, all or those of a view."""
    views = data.measurements.views
    every = list(range(data.measurements.n_rows))
    for turn in TURNS:
        yield _turned_over(data, given, every, turn, "")
    for v, view in enumerate(views) if len(views) > 1 else ():
        # Not upside down: of one camera, it may be held so.
        rows = np.flatnonzero(data.measurements.view == v).tolist()
        yield _turned_over(data, given, rows, LEFT_RIGHT, f" of view {view.name}")


def turned_images(
    data: OrderedDataset, given: Assumed, rows: Sequence[int], turn: Array
) -> Mistake:
    """Return some images of a view that are turned over while the others are not."""
    m = data.measurements
    which = f" {_images(data, rows)} of view {m.views[m.view[rows[0]]].name}"
    one = _turned_over(data, given, rows, turn, which)
    return replace(one, of_few=tuple(rows), test="")


def moved_cameras(
    data: OrderedDataset, given: Assumed, views: Sequence[Sequence[Sequence[int]]]
) -> Mistake:
    """Return images of some views taken from several positions, by the rows of each position."""
    m, place, things = data.measurements, given.place.copy(), _things(data)
    others, said = list[int](), list[str]()
    for places in views:
        others += [row for rows in places[1:] for row in rows]
        for k, rows in enumerate(places):
            place[list(rows)] = k
        in_file = sorted(places, key=lambda rows: int(data.order.rows[list(rows)].min()))
        of_each = [f"{_images(data, rows)} from {'another' if k else 'one'}"
                   for k, rows in enumerate(in_file)]  # fmt: skip
        what = "those" if said else f"the {things}"
        said.append(
            f"{what} of view {m.views[m.view[places[0][0]]].name} appear to be taken from "
            f"{len(places)} camera positions: {', '.join(of_each)}"
        )
    return Mistake(
        "camera moved",
        ", and ".join(said),
        "with a view for each position",
        f"give the {things} of each position their own view (for legcal init a folder, or a "
        "column view)",
        replace(given, place=place),
        of_few=tuple(others),
    )


def _things(data: OrderedDataset) -> str:
    """Return ``images`` or ``outlines``, whichever the dataset has."""
    return "images" if len(data.photographs.detect) else "outlines"


def _images(data: OrderedDataset, rows: Sequence[int]) -> str:
    """Return the name of the first of some images in the file, and the number of others."""
    in_file = sorted(data.order.rows[list(rows)].tolist())
    return f"{row_names(data.dataset.measurements)[in_file[0]]} and {len(rows) - 1} more"


def _turned_over(
    data: OrderedDataset, given: Assumed, rows: Sequence[int], turn: Array, which: str
) -> Mistake:
    kind, what = _TURNS_IN_WORDS[turn is UPSIDE_DOWN]
    flip = given.flip.copy()
    flip[list(rows)] *= turn
    things, remedy = _things(data), "replace these images with the originals"
    if things == "outlines":
        remedy = "correct the sign of a coordinate in their table"
    return Mistake(
        kind,
        f"the {things}{which} appear to be {what}",
        f"with the {things} turned back",
        remedy,
        replace(given, flip=flip),
        test=_LETTERING,
    )


def _of_model(given: Assumed) -> Iterator[Mistake]:
    """Yield a model made from a left-handed table of joints."""
    machine = given.machine
    mirrored = replace(
        machine,
        legs=tuple(_mirrored(leg) for leg in machine.legs),
        home=RigidTransform.from_matrix(_MIRROR_4 @ machine.home.as_matrix() @ _MIRROR_4),
    )
    yield Mistake(
        "handedness",
        "the model appears to be mirrored: the y coordinates of its joints have the wrong sign",
        "with the sign of y reversed",
        "reverse the sign of all y in the model",
        replace(given, machine=mirrored),
        test="compare the signs of y in the model with the positions of the legs in a photograph",
    )


def _mirrored(leg: Leg) -> Leg:
    """Return a leg with y of joints and axes reversed, and rotations too."""
    base, platform = (
        None if axis is None else _MIRROR @ axis for axis in (leg.base_axis, leg.platform_axis)
    )
    A, B, actuator = _MIRROR @ leg.A, _MIRROR @ leg.B, leg.actuator
    if actuator is not None:
        axis = _MIRROR @ actuator.axis * (-1.0 if actuator.turns else 1.0)
        actuator = replace(actuator, axis=axis, point=_MIRROR @ actuator.point)
    return replace(leg, A=A, B=B, base_axis=base, platform_axis=platform, actuator=actuator)


def _of_radii(given: Assumed) -> Iterator[Mistake]:
    """Yield diameters in place of radii: of all parts, or of all equally thick parts."""
    machine = given.machine
    radii = sorted({c.radius for leg in machine.legs for c in leg.cylinders})
    kinds = [r for i, r in enumerate(radii) if i == 0 or r > (1.0 + _SAME_RADIUS) * radii[i - 1]]

    def halved(only: float | None) -> Assumed:
        def radius(r: float) -> float:
            return 0.5 * r if only is None or abs(r - only) <= _SAME_RADIUS * r else r

        return replace(given, machine=machine.with_radii(lambda _, c: radius(c.radius)))

    which = [(None, "the radii"), *((r, f"the radius {1e3 * r:g} mm") for r in kinds[:2])]
    for only, name in which[: 1 if len(kinds) < 2 else None]:
        yield Mistake(
            "diameter for radius",
            f"{name} of the legs in the model appear{'s' * (only is not None)} to be twice too "
            "large: a diameter in place of a radius",
            f"with {name} halved",
            "correct the <visual> cylinders of the model",
            halved(only),
        )


def _of_cameras(given: Assumed) -> Iterator[Mistake]:
    """Yield focal lengths of images that were scaled or cropped."""
    yield from (_focal_length(given, factor) for factor in _FOCAL_LENGTHS)


def _focal_length(given: Assumed, factor: float) -> Mistake:
    return Mistake(
        "focal length",
        f"the focal length appears to be {factor:.2g} times the stated one: images were scaled or "
        "cropped after the camera was calibrated, or the zoom is different",
        "with that focal length",
        "calibrate the camera with unscaled images at the same zoom as these (legcal camera)",
        replace(given, focal=factor * given.focal),
        amount_of="focal length",
        finer=lambda more: _focal_length(given, factor * _FOCAL_STEP**more),
        opposite=replace(given, focal=given.focal / factor),
    )
