"""Common mistakes in a session, each as a changed hypothesis of readings, model or cameras."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.calibration.ordered_dataset import OrderedDataset
from legcal.data.image_tables import inverse
from legcal.data.measurements import row_names
from legcal.errors import DidNotConverge, ModelError
from legcal.files.schema import few
from legcal.geometry.types import Array, IntArray
from legcal.machine.home import home_at_mid_travel
from legcal.machine.kinematics import follow_poses
from legcal.machine.leg import Leg
from legcal.machine.model import Machine, readings_at
from legcal.perception.camera_search import LEFT_RIGHT, UPSIDE_DOWN

_STEP = 1.0 / 16.0  # smallest step from home to readings, relative to the way
_MIRROR = np.diag([1.0, -1.0, 1.0])
_MIRROR_4 = np.diag([1.0, -1.0, 1.0, 1.0])
# focal lengths of scaled and cropped images, relative to the stated one
_FOCAL_LENGTHS = (2.0, 0.5, 1.5, 2.0 / 3.0, 1.25, 0.8)
_FOCAL_STEP = 1.25  # approximate ratio of neighbours
_LATE = {1: "late", -1: "early"}  # in words, by the number of rows that readings are moved back
_ZEROS = 8  # steps of the zero of an encoder in its travel
_STILL = 0.1  # largest range of readings of an encoder at rest, in steps
_SAME_END = 0.01  # largest asymmetry of a symmetric travel, relative to the largest reading
_SAME_RADIUS = 1e-3  # largest relative difference of equal radii


TURNS = LEFT_RIGHT, UPSIDE_DOWN
_TURNS_IN_WORDS = (
    ("images mirrored", "mirrored"),
    ("images upside down", "turned upside down"),
)
_MOVE_ONE = "move one leg alone and compare the column that changes with the leg that moves"
_LETTERING = "look at lettering in an image"


@dataclass(frozen=True, eq=False)
class Assumed:
    """A hypothesis of a session: model, readings, image orientation and camera."""

    machine: Machine
    q: Array  # (n_rows, n_legs): readings [m or rad]
    flip: Array  # (n_rows, 2): -1 along mirrored image axes, else 1
    place: IntArray  # (n_rows,): number of the camera position within the view, from 0
    focal: float = 1.0  # focal length, relative to the stated one

    def joints(self, rows: Sequence[int]) -> tuple[Array, Array]:
        """Return the joint centres in the base link; see :func:`joints_of`."""
        return joints_of([(self, rows)])[0]

    def is_as(self, other: Assumed, rows: Sequence[int]) -> bool:
        """Return whether two hypotheses are equal in the given rows."""
        return (
            self.machine is other.machine
            and self.focal == other.focal
            and np.array_equal(self.q[rows], other.q[rows], equal_nan=True)
            and np.array_equal(self.flip[rows], other.flip[rows])
            and np.array_equal(self.place[rows], other.place[rows])
        )

    @property
    def is_in_travel(self) -> bool:
        """Whether all readings are inside the travel of their legs, with a tolerance."""
        return all(
            bool(leg.in_travel(self.q[:, j]).all())
            for j, leg in enumerate(self.machine.legs)
            if leg.is_motor
        )


@dataclass(frozen=True, eq=False)
class Mistake:
    """A possible mistake with its correction."""

    kind: str  # a word or two, for scripts
    what: str  # clause: "columns leg1_prismatic and leg2_prismatic appear to be swapped"
    mended: str  # phrase for the correction: "with the columns swapped"
    remedy: str
    true: Assumed  # hypothesis with the mistake corrected
    same_as: tuple[str, ...] = ()  # clauses for mistakes that images cannot distinguish from it
    test: str = ""  # test that confirms it: "move one leg alone and ..."
    is_small: bool = False  # whether estimated camera poses hardly change
    of_few: tuple[int, ...] = ()  # affected rows, if it affects single images
    amount_of: str = ""  # common name of mistakes that differ by their amount only
    # returns the mistake with its amount changed by fractions of a step; None without an amount
    finer: Callable[[float], Mistake] | None = None
    # Hypothesis with the opposite correction, which has to agree worse with the images than the
    # data as given. None if it may agree as well.
    opposite: Assumed | None = None


def joints_of(parts: Sequence[tuple[Assumed, Sequence[int]]]) -> list[tuple[Array, Array]]:
    """Return joint centres A and B of given rows under each of many hypotheses, in the base link.

    Each is (n_rows, n_legs, 3) [m]. Poses are found by continuation from home, all hypotheses of a
    machine together; poses that are not reached, and all other rows, are NaN.
    """
    joints = list[tuple[Array, Array]]()
    for hypothesis, _ in parts:
        shape = (len(hypothesis.q), hypothesis.machine.n_legs, 3)
        joints.append((np.full(shape, np.nan), np.full(shape, np.nan)))
    for machine in {id(hypothesis.machine): hypothesis.machine for hypothesis, _ in parts}.values():
        members = [k for k, (hypothesis, _) in enumerate(parts) if hypothesis.machine is machine]
        rows = [np.array(parts[k][1], dtype=np.intp) for k in members]
        q = np.concatenate(
            [parts[k][0].q[selected] for k, selected in zip(members, rows, strict=True)]
        )
        motors, ends = list(machine.motors), np.cumsum([len(selected) for selected in rows])
        first = readings_at(machine, machine.home)[motors]
        poses, reached = follow_poses(machine, machine.home, first, q[:, motors], _STEP)
        B = np.einsum("kij,nj->kni", poses[:, :, :3], machine.B_platform)
        B += poses[:, None, :, 3]
        B[reached < 1.0] = np.nan
        A = machine.A_at(q[:, list(machine.reads)])
        for k, selected, A_of, B_of in zip(
            members, rows, np.split(A, ends[:-1]), np.split(B, ends[:-1]), strict=True
        ):
            joints[k][0][selected], joints[k][1][selected] = A_of, B_of
    return joints


def as_given(data: OrderedDataset) -> Assumed:
    """Return the hypothesis that the files of the session are correct."""
    n = data.measurements.n_rows
    return Assumed(data.machine, data.measurements.q, np.ones((n, 2)), np.zeros(n, dtype=np.intp))


def mistakes(data: OrderedDataset, given: Assumed | None = None) -> list[Mistake]:
    """Return the possible mistakes of a session, the most common first; beside those undone."""
    given = as_given(data) if given is None else given
    encoders = _Encoders(given)
    candidates = [
        *_column_mistakes(data, given),
        *_numbering_mistakes(data, given),
        *_row_mistakes(data, given),
        *_unit_mistakes(encoders),
        *_direction_mistakes(encoders),
        *_zero_mistakes(encoders),
        *_image_mistakes(data, given),
        *_handedness_mistake(given),
        *_radius_mistakes(given),
        *(_focal_length(given, factor) for factor in _FOCAL_LENGTHS),
    ]
    return [
        mistake for mistake in candidates if mistake.true.is_in_travel or not given.is_in_travel
    ]


def both(first: Mistake, second: Mistake) -> Mistake:
    """Return two mistakes as one; *second* is one of a session in which the first is undone."""
    return Mistake(
        f"{first.kind} and {second.kind}",
        f"{first.what}, and {second.what}",
        f"{first.mended} and {second.mended}",
        f"{first.remedy}, and {second.remedy}",
        second.true,
    )


def _column_mistakes(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield wrong orders of the columns: two swapped, reversed, rotated."""
    order = inverse(data.order.legs)  # legs as the files have them
    motors = [j for j in order.tolist() if j in given.machine.motors]
    names = [given.machine.legs[j].prismatic for j in motors]

    def with_columns(source: Sequence[int]) -> Assumed:
        q = given.q.copy()
        q[:, motors] = given.q[:, [motors[k] for k in source]]
        return replace(given, q=q)

    n = len(motors)
    in_order = list(range(n))
    for i, k in combinations(in_order, 2):
        source = in_order.copy()
        source[i], source[k] = k, i
        swapped = [given.machine.legs[motors[i]], given.machine.legs[motors[k]]]
        legs = " and ".join(leg.motor_label for leg in swapped)
        noun = "motors" if all(leg.actuator for leg in swapped) else "legs"
        yield Mistake(
            "columns exchanged",
            f"columns {names[i]} and {names[k]} appear to be swapped",
            "with the columns swapped",
            "swap the headers of these columns",
            with_columns(source),
            (f"{noun} {legs} appear to be swapped in the model",),
            _MOVE_ONE,
        )
    if n > 3:  # reversing three columns is the same as swapping two
        yield Mistake(
            "columns reversed",
            "the columns of readings appear to be in reverse order",
            "with the columns reversed",
            "reverse the headers of the columns",
            with_columns(in_order[::-1]),
            ("the legs appear to be numbered in reverse order in the model",),
            _MOVE_ONE,
        )
    for k in range(1, n) if n > 2 else ():
        yield Mistake(
            "columns rotated",
            f"the columns of readings appear to be rotated (column {names[0]} contains the "
            f"readings of {names[(n - k) % n]})",
            f"with the columns rotated by {k}",
            "correct the headers of the columns",
            with_columns([(j + k) % n for j in in_order]),
            ("the legs appear to be numbered from a different starting leg in the model",),
            _MOVE_ONE,
        )


def _numbering_mistakes(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield joints of the platform, or of the base, that the model numbers wrongly.

    From another one on, the other way round, or two of them exchanged. Base joints with their
    motors that are some numbers on are platform joints and columns that are as many back.
    """
    machine = given.machine
    files = inverse(data.order.legs).tolist()  # legs as the files have them
    motors = [j for j in files if j in machine.motors]
    groups = [[j for j in files if machine.reads[j] == motor] for motor in motors]
    n, names = len(groups), [machine.legs[motor].motor_label for motor in motors]
    if n < 3 or len({len(group) for group in groups}) > 1:
        return

    def with_platform_joints(source: Sequence[int]) -> Assumed:
        legs = list(machine.legs)
        for i, group in enumerate(groups):
            for j, other in zip(group, groups[source[i]], strict=True):
                end = machine.legs[other]
                legs[j] = replace(legs[j], B=end.B, platform_axis=end.platform_axis)
        return replace(given, machine=_at_reachable_home(replace(machine, legs=tuple(legs))))

    def with_base_joints(source: Sequence[int], platform: Assumed) -> Assumed:
        q = given.q.copy()
        q[:, motors] = given.q[:, [motors[i] for i in source]]
        return replace(platform, q=q)

    turns = {leg.actuator.turns for leg in machine.legs if leg.actuator is not None}
    base = "base joints" if not turns else "arms" if turns == {True} else "carriages"
    turned = {k: [(i + k) % n for i in range(n)] for k in range(1, n)}
    renumbered = [(k, with_platform_joints(source)) for k, source in turned.items()]
    # The home that the model states is likelier than one that is solved for.
    for k, true in sorted(renumbered, key=lambda one: one[1].machine.home is not machine.home):
        yield Mistake(
            "platform joints renumbered",
            "the platform joints of the model appear to be numbered from another one on "
            f"({names[0]} has that of {names[-k]})",
            f"with the platform joints renumbered by {k}",
            "correct the numbers of the platform joints in the model",
            true,
            test=_MOVE_ONE,
        )
        yield Mistake(
            "base joints renumbered",
            f"the {base} of the model appear to be turned against the platform ({names[0]} stands "
            f"where {names[k]} should)",
            f"with the {base} renumbered by {n - k}",
            f"correct the numbers of the {base} in the model",
            with_base_joints(turned[k], true),
            test=_MOVE_ONE,
        )
    reversed_order = list(range(n))[::-1]
    true = with_platform_joints(reversed_order)
    for noun, turned_round in (
        (base, with_base_joints(reversed_order, true)),
        ("platform joints", true),
    ):
        yield Mistake(
            "joints reversed",
            f"the {noun} of the model appear to be numbered the other way round",
            f"with the {noun} in reverse order",
            f"reverse the numbers of the {noun} in the model",
            turned_round,
            test=_MOVE_ONE,
        )
    for one, other in combinations(range(n), 2) if n > 3 else ():
        source = list(range(n))
        source[one], source[other] = other, one
        true = with_platform_joints(source)
        for noun, swapped in (base, with_base_joints(source, true)), ("platform joints", true):
            yield Mistake(
                "joints exchanged",
                f"the {noun} of {names[one]} and {names[other]} appear to be swapped in the model",
                f"with these {noun} swapped",
                f"swap these {noun} in the model",
                swapped,
                test=_MOVE_ONE,
            )


def _at_reachable_home(machine: Machine) -> Machine:
    """Return a machine with its home, or where it is out of travel with one within, if any."""
    q = readings_at(machine, machine.home)
    if all(bool(leg.in_travel(q[j])) for j, leg in enumerate(machine.legs) if leg.is_motor):
        return machine
    try:
        return replace(machine, home=home_at_mid_travel(machine))
    except (DidNotConverge, ModelError):
        return machine


def limited_to(data: OrderedDataset, given: Assumed, mistake: Mistake, rows: IntArray) -> Mistake:
    """Return a mistake in the readings of some rows only, which follow each other in the file."""
    m, names = data.measurements, row_names(data.dataset.measurements)
    views = [f" of view {m.views[v].name}" for v in m.view[rows].tolist()]
    first, last = (names[data.order.rows[row]] for row in (rows[0], rows[-1]))
    where = f"from {first}{views[0]} to {last}{views[-1]}"
    if mistake.amount_of:  # that names the view
        where = f"from {first} on"
    elif data.order.rows[rows[-1]] == m.n_rows - 1:
        where = f"from {first}{views[0]} on"
    elif set(rows.tolist()) == set(np.flatnonzero(m.view == m.view[rows[0]]).tolist()):
        where = f"in{views[0].removeprefix(' of')}"
    q = given.q.copy()
    q[rows] = mistake.true.q[rows]
    return replace(
        mistake,
        what=f"{where}, {mistake.what}",
        mended=f"{mistake.mended} there",
        remedy="correct the readings there, and look for what changed (a plug, a setting, a row or "
        "image that is missing or doubled)",
        true=replace(given, q=q),
        same_as=(),
        test="",
    )


def _row_mistakes(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield readings shifted by a row, in all views, in one, or of one motor, and in text order."""
    whole, views = np.argsort(data.order.rows, kind="stable"), data.measurements.views
    of_view = [whole[data.measurements.view[whole] == v] for v in range(len(views))]
    nonempty = [rows for rows in of_view if len(rows)]
    parts = [(nonempty, "")]
    if len(nonempty) > 1:
        names = [f" of view {view.name}" for view in views]
        parts += [([rows], name) for rows, name in zip(of_view, names, strict=True)]
    for shifted, name in parts:
        if all(len(rows) > 2 for rows in shifted):
            yield from (_shifted(given, shifted, k, name) for k in _LATE)
    for motor in given.machine.motors if len(whole) > 2 else ():
        yield from (_column_shifted(given, whole, motor, k) for k in _LATE)
    for tables in (nonempty, [whole])[: len(nonempty)]:
        yield from _text_order(tables, given)


def _shifted(given: Assumed, tables: Sequence[IntArray], k: int, of_view: str = "") -> Mistake:
    q = given.q.copy()
    for rows in tables:
        q[rows] = given.q[np.roll(rows, -k)]
    return Mistake(
        "readings shifted",
        f"the readings{of_view} appear to be one row {_LATE[k]} (each image is paired with the "
        "readings of a neighbour)",
        "with the readings moved by 1 row",
        "check which image belongs to which row",
        replace(given, q=q),
        amount_of=f"rows{of_view}",
    )


def _column_shifted(given: Assumed, rows: IntArray, motor: int, k: int) -> Mistake:
    """Return readings of one motor shifted by a row, as by a cell that was deleted."""
    q, name = given.q.copy(), given.machine.legs[motor].prismatic
    q[rows, motor] = given.q[np.roll(rows, -k), motor]
    return Mistake(
        "column shifted",
        f"the readings in column {name} appear to be one row {_LATE[k]}, those of other columns "
        "not",
        "with that column moved by 1 row",
        "compare that column with the record of the session (a cell that was added or deleted)",
        replace(given, q=q),
        amount_of=f"rows of {name}",
    )


def shifted_from(data: OrderedDataset, given: Assumed, first: int) -> list[Mistake]:
    """Return readings shifted by a row from one row of the file to the end, through all views."""
    whole = np.argsort(data.order.rows, kind="stable")
    return [limited_to(data, given, _shifted(given, [whole], k), whole[first:]) for k in _LATE]


def _text_order(tables: Sequence[IntArray], given: Assumed) -> Iterator[Mistake]:
    """Yield readings that are by number where images are sorted as text, or the other way round.

    *tables* are rows that are numbered from 1, in the order of the file.
    """
    if all(len(rows) < 10 for rows in tables):
        return
    for is_undone in (False, True):
        q = given.q.copy()
        for rows in tables:
            as_text = rows[sorted(range(len(rows)), key=lambda k: str(k + 1))]
            q[as_text if is_undone else rows] = given.q[rows if is_undone else as_text]
        yield Mistake(
            "order of text",
            "the readings appear to be sorted in another order than the images (1, 10, 11, ..., 2 "
            "as text against 1, 2, 3, ... as numbers)",
            "with the readings in the order of the images",
            "sort both by number, and check which image belongs to which row",
            replace(given, q=q),
        )


@dataclass(frozen=True, eq=False)
class _Encoders:
    """The encoders of a session with their readings and names."""

    given: Assumed

    @cached_property
    def legs(self) -> list[Leg]:
        """The leg of each encoder, or the first of several legs."""
        return [self.given.machine.legs[j] for j in self.given.machine.motors]

    @property
    def names(self) -> list[str]:
        """The columns of the encoders in the table of readings."""
        return [str(leg.prismatic) for leg in self.legs]

    @property
    def indices(self) -> list[int]:
        """Indices of all encoders."""
        return list(range(len(self.legs)))

    @cached_property
    def q(self) -> Array:
        """Readings (n_rows, n_encoders) [m or rad]."""
        return self.given.q[:, list(self.given.machine.motors)]

    @property
    def move_legs_alone(self) -> bool:
        """Whether each encoder reads the length of a leg."""
        return not any(leg.actuator for leg in self.legs)

    @property
    def angular(self) -> list[int]:
        """Indices of the encoders that read angles."""
        return [k for k, leg in enumerate(self.legs) if leg.reads_angle]

    @cached_property
    def zero_steps(self) -> Array:
        """Step of the zero of each encoder, (n_encoders,) [m or rad]."""
        width = np.array([leg.travel[1] - leg.travel[0] for leg in self.legs])
        has_travel = (width > 0.0) & np.isfinite(width)
        return np.where(has_travel, width, np.ptp(self.q, axis=0)) / _ZEROS

    @property
    def moving(self) -> list[int]:
        """Indices of the encoders that move, whose direction and zero images can confirm."""
        return np.flatnonzero(np.ptp(self.q, axis=0) > _STILL * self.zero_steps).tolist()

    @property
    def in_words(self) -> str:
        """Noun for all encoders."""
        return "legs" if self.move_legs_alone else "motors"

    def reading(self, q: Array, encoders: Sequence[int]) -> Assumed:
        """Return the hypothesis with other readings (n_rows, n) of some encoders."""
        motors, changed = self.given.machine.motors, self.given.q.copy()
        changed[:, [motors[k] for k in encoders]] = q
        return replace(self.given, q=changed)


def _unit_mistakes(encoders: _Encoders) -> Iterator[Mistake]:
    """Yield angles in another unit; lengths in another unit are outside the travel and refused."""
    turning = encoders.angular
    columns = (
        ""
        if len(turning) == len(encoders.legs)
        else f" of {few([encoders.names[k] for k in turning])}"
    )
    angles = (np.pi / 180.0, "in degrees"), (180.0 / np.pi, "radians interpreted as degrees")
    for scale, unit in angles if turning else ():
        yield Mistake(
            "unit",
            f"the readings{columns} appear to be {unit}",
            "interpreted that way",
            f"multiply these readings by {scale:g}",
            encoders.reading(scale * encoders.q[:, turning], turning),
        )


def _direction_mistakes(encoders: _Encoders) -> Iterator[Mistake]:
    """Yield readings with reversed direction, of one encoder or of all."""
    q = encoders.q
    ends = np.array([sum(leg.travel) for leg in encoders.legs])
    ends = np.where(np.isfinite(ends), ends, q.min(axis=0) + q.max(axis=0))
    # For a symmetric travel, as of most servos, reversal is the same as the opposite sign.
    reversible = np.abs(ends) > _SAME_END * np.abs(q).max(axis=0)
    for reversed_q, description, affected in (
        (-q, "the opposite sign", encoders.indices),
        (ends - q, "the opposite direction", np.flatnonzero(reversible).tolist()),
    ):
        if affected:
            yield Mistake(
                "direction of encoders",
                f"the readings of all {encoders.in_words} appear to have {description}",
                "with the readings reversed",
                "reverse them in the table of readings",
                encoders.reading(reversed_q, encoders.indices),
            )
        for k in (k for k in encoders.moving if k in affected):
            yield Mistake(
                "direction of an encoder",
                f"column {encoders.names[k]} appears to have {description}",
                "with the column reversed",
                "reverse the column in the table of readings",
                encoders.reading(reversed_q[:, k : k + 1], [k]),
            )


def _zero_mistakes(encoders: _Encoders) -> Iterator[Mistake]:
    """Yield readings with a zero offset, of one encoder or of all."""
    are_alike = len(encoders.angular) in (0, len(encoders.legs))  # of one unit
    for m in (*range(-_ZEROS, 0), *range(1, _ZEROS + 1)):
        if are_alike:
            yield _zero(encoders, None, m)
        for k in encoders.moving:
            yield _zero(encoders, k, m)


def _zero(encoders: _Encoders, k: int | None, m: float) -> Mistake:
    """Return a zero offset of the k-th encoder, or a common one of all, by -m steps."""
    which = encoders.indices if k is None else [k]
    offset = -m * float(encoders.zero_steps[which].mean())
    is_angle = which[0] in encoders.angular
    amount = f"{np.degrees(offset):+.0f} deg" if is_angle else f"{1e3 * offset:+.0f} mm"
    if k is None:
        kind, appear = "zero of encoders", f"the readings of all {encoders.in_words} appear"
        zero = "the offsets" if encoders.move_legs_alone else "the zeros of motors"
        table = "the table of readings"
    else:
        name = encoders.names[k]
        kind, appear = "zero of an encoder", f"column {name} appears"
        zero = f"the zero of {name}" if encoders.legs[k].actuator else "the offset of the leg"
        table = "the column in the table of readings"
    return Mistake(
        kind,
        f"{appear} to have a zero offset of about {amount}",
        "with the offset removed",
        f"correct {table}, or {zero} in the model",
        encoders.reading(encoders.q[:, which] - offset, which),
        is_small=True,
        amount_of=f"zero of {'all encoders' if k is None else f'encoder {k}'}",
        finer=lambda more: _zero(encoders, k, m + more),
    )


def _image_mistakes(data: OrderedDataset, given: Assumed) -> Iterator[Mistake]:
    """Yield mirrored or upside-down images, all or those of a view."""
    views = data.measurements.views
    all_rows = list(range(data.measurements.n_rows))
    for turn in TURNS:
        yield _turned_over(data, given, all_rows, turn, "")
    for v, view in enumerate(views) if len(views) > 1 else ():
        # Not upside down: a single camera may be mounted that way.
        rows = np.flatnonzero(data.measurements.view == v).tolist()
        yield _turned_over(data, given, rows, LEFT_RIGHT, f" of view {view.name}")


def turned_images(
    data: OrderedDataset, given: Assumed, rows: Sequence[int], turn: Array
) -> Mistake:
    """Return mirrored or upside-down images in some rows of a view."""
    m = data.measurements
    rows_in_words = f" {_images(data, rows)} of view {m.views[m.view[rows[0]]].name}"
    mistake = _turned_over(data, given, rows, turn, rows_in_words)
    return replace(mistake, of_few=tuple(rows), test="")


def moved_cameras(
    data: OrderedDataset, given: Assumed, views: Sequence[Sequence[Sequence[int]]]
) -> Mistake:
    """Return views with several camera positions, each given by its rows."""
    m, place, noun = data.measurements, given.place.copy(), _observation_noun(data)
    moved_rows, clauses = list[int](), list[str]()
    for places in views:
        moved_rows += [row for rows in places[1:] for row in rows]
        for k, rows in enumerate(places):
            place[list(rows)] = k
        in_file = sorted(places, key=lambda rows: int(data.order.rows[list(rows)].min()))
        positions_in_words = ", ".join(
            f"{_images(data, rows)} from position {k}" for k, rows in enumerate(in_file, 1)
        )
        subject = "those" if clauses else f"the {noun}"
        clauses.append(
            f"{subject} of view {m.views[m.view[places[0][0]]].name} appear to be taken from "
            f"{len(places)} camera positions ({positions_in_words})"
        )
    return Mistake(
        "camera moved",
        ", and ".join(clauses),
        "with a view for each position",
        f"give the {noun} of each position a separate view (for legcal init a folder, or a "
        "column view)",
        replace(given, place=place),
        of_few=tuple(moved_rows),
    )


def _observation_noun(data: OrderedDataset) -> str:
    """Return the noun for the observations of the session."""
    return "images" if len(data.photographs.detect) else "outlines"


def _images(data: OrderedDataset, rows: Sequence[int]) -> str:
    """Return images in words: the first one in the file and the number of others."""
    in_file = sorted(data.order.rows[list(rows)].tolist())
    others = f"{len(rows) - 1} other{'s' * (len(rows) != 2)}"
    return f"{row_names(data.dataset.measurements)[in_file[0]]} and {others}"


def _turned_over(
    data: OrderedDataset, given: Assumed, rows: Sequence[int], turn: Array, rows_in_words: str
) -> Mistake:
    kind, description = _TURNS_IN_WORDS[turn is UPSIDE_DOWN]
    flip = given.flip.copy()
    flip[list(rows)] *= turn
    noun, remedy = _observation_noun(data), "replace these images by the originals"
    if noun == "outlines":
        remedy = "correct the direction of an axis of their table"
    return Mistake(
        kind,
        f"the {noun}{rows_in_words} appear to be {description}",
        f"with the {noun} turned back",
        remedy,
        replace(given, flip=flip),
        test=_LETTERING,
    )


def _handedness_mistake(given: Assumed) -> Iterator[Mistake]:
    """Yield the joints of left-handed tables: of all joints, of the base or of the platform."""
    machine = given.machine
    mirrored = tuple(_mirrored(leg) for leg in machine.legs)
    home = RigidTransform.from_matrix(_MIRROR_4 @ machine.home.as_matrix() @ _MIRROR_4)
    both = list(zip(machine.legs, mirrored, strict=True))
    base = [replace(one, B=leg.B, platform_axis=leg.platform_axis) for leg, one in both]
    platform = [replace(leg, B=one.B, platform_axis=one.platform_axis) for leg, one in both]
    for of, these, changed in (
        ("", "all y", replace(machine, legs=mirrored, home=home)),
        ("base of the ", "y of the base joints", replace(machine, legs=tuple(base))),
        ("platform of the ", "y of the platform joints", replace(machine, legs=tuple(platform))),
    ):
        yield Mistake(
            f"handedness of the {of}model" if of else "handedness",
            f"the {of}model appears mirrored: the y coordinates of its joints have the wrong sign",
            "with the signs of y reversed",
            f"reverse the signs of {these} in the model",
            replace(given, machine=_at_reachable_home(changed)),
            test="compare the signs of y in the model with the order of the legs in an image",
        )


def _mirrored(leg: Leg) -> Leg:
    """Return a leg with y of its joints and axes reversed; axes of rotation are pseudovectors."""
    base, platform = (
        None if axis is None else _MIRROR @ axis for axis in (leg.base_axis, leg.platform_axis)
    )
    A, B, actuator = _MIRROR @ leg.A, _MIRROR @ leg.B, leg.actuator
    if actuator is not None:
        axis = _MIRROR @ actuator.axis * (-1.0 if actuator.turns else 1.0)
        actuator = replace(actuator, axis=axis, point=_MIRROR @ actuator.point)
    return replace(leg, A=A, B=B, base_axis=base, platform_axis=platform, actuator=actuator)


def _radius_mistakes(given: Assumed) -> Iterator[Mistake]:
    """Yield diameters in place of radii: of all parts, or of parts of one radius."""
    machine = given.machine
    radii = sorted({c.radius for leg in machine.legs for c in leg.cylinders})
    kinds = [r for i, r in enumerate(radii) if i == 0 or r > (1.0 + _SAME_RADIUS) * radii[i - 1]]

    def halved(single: float | None) -> Assumed:
        def radius(r: float) -> float:
            return 0.5 * r if single is None or abs(r - single) <= _SAME_RADIUS * r else r

        return replace(given, machine=machine.with_radii(lambda _, c: radius(c.radius)))

    all_radii: list[tuple[float | None, str, str]] = [(None, "the radii", "appear to be diameters")]
    single_radii = [(r, f"the radius {1e3 * r:g} mm", "appears to be a diameter") for r in kinds]
    for single, name, appears in all_radii + (single_radii[:2] if len(kinds) > 1 else []):
        yield Mistake(
            "diameter for radius",
            f"{name} of the legs in the model {appears}",
            f"with {name} halved",
            "correct the <visual> cylinders of the model",
            halved(single),
        )


def _focal_length(given: Assumed, factor: float) -> Mistake:
    """Return the focal length of images that were scaled or cropped."""
    return Mistake(
        "focal length",
        f"the focal length appears to be {factor:.2g} times the stated one (images scaled or "
        "cropped after the camera calibration, or another zoom)",
        "with that focal length",
        "calibrate the camera with unscaled images at the same zoom as these (legcal camera)",
        replace(given, focal=factor * given.focal),
        amount_of="focal length",
        finer=lambda more: _focal_length(given, factor * _FOCAL_STEP**more),
        opposite=replace(given, focal=given.focal / factor),
    )
