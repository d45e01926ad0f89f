"""Platforms of several bodies: H4 and I4 against their own closure and outline equations."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from articulated import HOME, Articulated, machine
from command_line import run
from scipy.spatial.transform import RigidTransform, Rotation
from thinned import thinned

from legcal.calibration.identify.identifiability import conditions_of, identifiability
from legcal.calibration.identify.predicted_observations import planned_observations
from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.scale import is_scale_open
from legcal.data.dataset import load_dataset
from legcal.errors import OutOfClass, UsageError
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine.inspection import machine_document
from legcal.machine.kinematics import Follower, forward_kinematics, inverse_kinematics
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.machine.parameters import parametrization_of

KINDS = list(product(("h4", "i4"), (False, True)))
# Parameters with all gauges, and those that images determine: of an I4 inside its ties
COUNTS = {
    ("h4", False): (72, 58),
    ("h4", True): (80, 66),
    ("i4", False): (66, 40),
    ("i4", True): (74, 40),
}
IMAGES = {"h4": 12, "i4": 28}  # more than what an I4 ties: one each, at most
STEP = 1e-3  # of differences of fourth order


Loaded = Callable[[str, bool], Machine]


def edit(path: Path, old: str, new: str) -> None:
    """Replace a text of a file, which has it."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> Loaded:
    folder = tmp_path_factory.mktemp("articulated")

    @cache
    def load(kind: str, turning: bool) -> Machine:
        return load_mechanism(machine(kind, turning=turning).write(folder / f"{kind}-{turning}"))

    return load


# --- the same machine, written out once more ----------------------------------------------------


class Moved(NamedTuple):
    """Unknowns of cases, as steps from the drawing: of the machine, an image, the camera."""

    numbers: Array  # (n, ...)
    image: Array  # turn and place of the platform, readings, joints inside
    camera: Array  # turn and place


Shown = Callable[[Moved], Array]  # (n, m)


class Written:
    """A machine by its equations alone."""

    def __init__(self, drawn: Articulated) -> None:
        self.drawn = drawn
        of_motor = 4 if drawn.turning else 2
        of_joint = [4 if joint.kind == "revolute" else 2 for joint in drawn.inside]
        self.parts = np.cumsum([0, 4 * of_motor, 24, 24, 8, *of_joint])
        self.n_numbers, self.n_image = int(self.parts[-1]), 10 + len(drawn.inside)

    def at(self, image: Array) -> Moved:
        return Moved(np.zeros((1, self.n_numbers)), image[None], np.zeros((1, 6)))

    def ends(self, at: Moved) -> tuple[Array, Array, Array]:
        """Return A and B in the base, and the lengths of rods."""
        drawn, n = self.drawn, max(len(part) for part in at)
        numbers, image = (np.array(np.broadcast_to(x, (n, x.shape[1]))) for x in at[:2])
        motors, of_A, of_B, lengths, *inside = np.split(numbers, self.parts[1:-1], axis=1)
        A = drawn.A + of_A.reshape(n, 8, 3)
        B = drawn.B - HOME + of_B.reshape(n, 8, 3)
        for j, k in enumerate(drawn.motor.tolist()):
            line = motors.reshape(n, 4, -1)[:, k]
            point, axis = drawn.motor_point[k], drawn.motor_axis[k]
            A[:, j] = _carried(A[:, j], point, axis, line, image[:, 6 + k])
        for i, (joint, line) in enumerate(zip(drawn.inside, inside, strict=True)):
            for j in np.flatnonzero(drawn.body == i + 1).tolist():
                B[:, j] = _carried(B[:, j], joint.point, joint.axis, line, image[:, 10 + i])
        turn = Rotation.from_rotvec(image[:, :3]).as_matrix()
        B = np.einsum("nij,nkj->nki", turn, B) + (HOME + image[:, 3:6])[:, None]
        return A, B, np.linalg.norm(drawn.B - drawn.A, axis=1) + lengths

    def closure(self, at: Moved) -> Array:
        A, B, length = self.ends(at)
        return np.asarray(np.linalg.norm(B - A, axis=2) - length)

    def lines(self, at: Moved) -> Array:
        """Return the rods as lines in the camera: what outlines of known radius show."""
        A, B = self._seen(at)
        u = (B - A) / np.linalg.norm(B - A, axis=2)[..., None]
        return np.concatenate([u, np.cross(A, u)], axis=2).reshape(len(u), -1)

    def outlines(self, at: Moved) -> Array:
        """Return the planes of the rods, and the logarithm of how far both ends are."""
        A, B = self._seen(at)
        normal = np.cross(A, B)
        normal /= np.linalg.norm(normal, axis=2)[..., None]
        away = [np.log(np.linalg.norm(end, axis=2)) for end in (A, B)]
        return np.concatenate([normal.reshape(len(A), -1), *away], axis=1)

    def _seen(self, at: Moved) -> tuple[Array, Array]:
        A, B, _ = self.ends(at)
        turn = Rotation.from_rotvec(at.camera[:, :3]).as_matrix()
        place = (np.array([1.3, 0.9, -0.4]) + at.camera[:, 3:])[:, None]
        return (A - place) @ np.swapaxes(turn, 1, 2), (B - place) @ np.swapaxes(turn, 1, 2)

    def image_at(self, q: Array) -> Array:
        """Return an image's unknowns at readings, followed from home."""
        image, free = np.zeros(self.n_image), np.r_[:6, 10 : self.n_image]
        for part, n_steps in ((1.0 / 3.0, 2), (2.0 / 3.0, 2), (1.0, 5)):
            image[6:10] = part * q
            for _ in range(n_steps):
                slopes = self.slopes(self.closure, image, "image")[:, free]
                missed = self.closure(self.at(image))[0]
                image[free] -= np.linalg.lstsq(slopes, missed, rcond=1e-7)[0]
        assert np.abs(self.closure(self.at(image))).max() < 1e-12
        return image

    def slopes(self, function: Shown, image: Array, by: str) -> Array:
        """Return derivatives (m, n) by central differences, at an image of the drawn machine."""
        at = self.at(image)
        value = getattr(at, by)
        steps = STEP * np.eye(value.shape[1])
        two, one, back, far = (
            function(at._replace(**{by: value + k * steps})) for k in (2.0, 1.0, -1.0, -2.0)
        )
        return np.asarray((8.0 * (one - back) - (two - far)).T / (12.0 * STEP))


def _carried(point: Array, at: Array, axis: Array, line: Array, value: Array) -> Array:
    """Return points (n, 3) that revolutes (n, 4) or prismatics (n, 2) have carried."""
    basis = normal_basis(axis)
    moved = axis + line[:, :2] @ basis
    moved /= np.linalg.norm(moved, axis=1)[:, None]
    if line.shape[1] == 2:
        return np.asarray(point + value[:, None] * moved)
    pivot = at + line[:, 2:] @ basis
    turn = Rotation.from_rotvec(value[:, None] * moved).as_matrix()
    return np.asarray(pivot + np.einsum("nij,nj->ni", turn, point - pivot))


def rank(matrix: Array) -> int:
    """Return the rank of a matrix whose singular values leave no doubt about it."""
    singular = np.append(np.linalg.svd(matrix, compute_uv=False), 1e-13)
    ratio = singular[:-1] / np.maximum(singular[1:], 1e-13)
    found = int(np.argmax(ratio * (singular[:-1] > 1e-8))) + 1
    assert ratio[found - 1] > 30.0, singular[found - 3 : found + 3]
    return found


def readings(drawn: Articulated, n: int, seed: int) -> Array:
    reach = 0.05 if not drawn.turning else 0.2 if len(drawn.inside) > 1 else 0.4
    return np.random.default_rng(seed).uniform(-reach, reach, (n, 4))


@cache
def images(kind: str, turning: bool) -> list[Array]:
    written = Written(machine(kind, turning=turning))
    return [written.image_at(q) for q in readings(written.drawn, IMAGES[kind], 5)]


@cache
def determined(kind: str, turning: bool, *, radii: bool) -> tuple[int, int, int]:
    """Return how many numbers there are, may vary at all, and are determined by images.

    The camera is unknown, readings are exact, and radii are too unless they are free.
    """
    written = Written(machine(kind, turning=turning))
    n, k = written.n_numbers, IMAGES[kind]
    n_shared = n + 6 + 8 * radii
    width = n_shared + k * written.n_image
    demanded, shown = list[Array](), list[Array]()
    function = written.outlines if radii else written.lines
    for i, at in enumerate(images(kind, turning)):
        own = slice(n_shared + i * written.n_image, n_shared + (i + 1) * written.n_image)
        closed = np.zeros((12, width))
        closed[:8, :n] = written.slopes(written.closure, at, "numbers")
        closed[:8, own] = written.slopes(written.closure, at, "image")
        closed[8:, own] = np.eye(4, written.n_image, 6)
        demanded.append(closed)
        seen = np.zeros((function(written.at(at)).shape[1], width))
        seen[:, :n] = written.slopes(function, at, "numbers")
        seen[:, n : n + 6] = written.slopes(function, at, "camera")
        seen[:, own] = written.slopes(function, at, "image")
        if radii:  # a rod twice as thick looks half as far
            seen[24:, n + 6 : n_shared] = -np.tile(np.eye(8), (2, 1))
        shown.append(seen)
    rank_demanded = rank(np.concatenate(demanded))
    rank_all = rank(np.concatenate(demanded + shown))
    free = width - rank_demanded - 6 - 8 * radii
    return n, free, free - (width - rank_all)


# --- loading and kinematics ---------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "turning"), KINDS)
def test_they_load_with_the_mobility_of_their_closure_equations(
    kind: str, turning: bool, loaded: Loaded
) -> None:
    found, drawn = loaded(kind, turning), machine(kind, turning=turning)
    written = Written(drawn)
    for q in readings(drawn, 3, 1):
        slopes = written.slopes(written.closure, written.image_at(q), "image")
        assert written.n_image - rank(slopes) == found.mobility == 4
        held = np.concatenate([slopes, np.eye(4, written.n_image, 6)])
        assert rank(held) == written.n_image
    assert found.motor_rank == 4
    document = machine_document(found)
    ends = np.where(drawn.body > 0, "R" if kind == "h4" else "P", "")
    first = "R" if turning else "P"
    assert [leg["type"] for leg in document["legs"]] == [f"{first}SS{end}" for end in ends]
    for joint in drawn.inside:
        shown = document["internal_joints"][joint.name]
        assert np.allclose(shown["axis" if kind == "h4" else "direction"], joint.axis)
        assert shown["follows"] == (kind == "h4")
        assert shown["at_home"] == pytest.approx(0.0, abs=1e-12)
        assert shown["travel"] == [-0.35, 0.35] if kind == "h4" else [-0.12, 0.12]
    assert np.allclose(document["home"]["xyz"], HOME, atol=1e-9)


@pytest.mark.parametrize(("kind", "turning"), KINDS)
def test_kinematics_are_those_of_the_closure_equations_both_ways(
    kind: str, turning: bool, loaded: Loaded
) -> None:
    found, drawn = loaded(kind, turning), machine(kind, turning=turning)
    written, follower = Written(drawn), Follower(found)
    joints = [joint.name for joint in drawn.inside]
    for q in readings(drawn, 4, 2):
        image = written.image_at(q)
        turn = Rotation.from_rotvec(image[:3])
        wanted = RigidTransform.from_components(HOME + image[3:6], turn)
        at = q[drawn.motor]
        T = forward_kinematics(found, at)
        assert np.abs(T.as_matrix() - wanted.as_matrix()).max() < 1e-8
        follower.move_to(at)
        inside = [found.chain.value(follower.configuration, name) for name in joints]
        assert np.abs(inside - image[10:]).max() < 1e-7
        stands = {} if kind == "h4" else dict(zip(joints, inside, strict=True))
        assert np.abs(inverse_kinematics(found, T, stands) - at).max() < 1e-8
    if kind == "i4":  # without it the guide stands at zero
        still = inverse_kinematics(found, T)
        assert np.abs(still - at).max() > 1e-3
        assert np.abs(forward_kinematics(found, still).as_matrix() - T.as_matrix()).max() < 1e-9
    with pytest.raises(UsageError, match="'lift', needed a joint inside the platform"):
        inverse_kinematics(found, T, {"lift": 0.1})


def test_a_platform_beside_the_middle_is_refused_with_the_one_to_name(tmp_path: Path) -> None:
    path = machine("h4", turning=True).write(tmp_path, platform="bar1")
    with pytest.raises(OutOfClass, match=r"'bar2' .* 'hinge\d' .* name the body between these in"):
        load_mechanism(path)


def test_the_platform_is_proposed_where_the_file_names_none(tmp_path: Path) -> None:
    found = load_mechanism(machine("h4", turning=True).write(tmp_path, block=False))
    assert (found.platform, found.mobility, found.motor_rank) == ("platform", 4, 4)
    assert len(found.internal_joints) == 2


def _without_motor(made: Articulated, folder: Path) -> Path:
    """Write it with a fixed arm."""
    path = made.write(folder)
    edit(path.with_suffix(".urdf"), 'name="motor1" type="revolute"', 'name="motor1" type="fixed"')
    edit(path, "    motor1: 0.0\n", "")
    edit(path, "- motor1\n", "")
    return path


def _with_two_joints_in_a_row(made: Articulated, folder: Path) -> Path:
    """Write it with a slider between the platform and a hinge."""
    path, platform = made.write(folder), '<parent link="platform"/>'
    hinge, between = '<joint name="hinge1" type="revolute">', '<parent link="between"/>'
    lift = (
        f'<link name="between"/><joint name="lift" type="prismatic">{platform}'
        '<child link="between"/><axis xyz="0 0 1"/>'
        '<limit lower="-0.1" upper="0.1" effort="1" velocity="1"/></joint>'
    )
    edit(path.with_suffix(".urdf"), hinge + platform, lift + hinge + between)
    return path


def _with_more_motors(made: Articulated, folder: Path) -> Path:
    """Write it with a ninth rod on a fifth motor."""

    def beside(rows: Array, row: list[float]) -> Array:
        return np.concatenate([rows, [row]])

    return replace(
        made,
        motor_point=beside(made.motor_point, [0.1, 0.25, 0.01]),
        motor_axis=beside(made.motor_axis, [1.0, 0.0, 0.0]),
        motor=np.append(made.motor, 4),
        A=beside(made.A, [0.1, 0.5, 0.0]),
        B=beside(made.B, (HOME + np.array([0.02, 0.01, 0.03])).tolist()),
        body=np.append(made.body, 0),
    ).write(folder)


def _with_rods_on_the_hinge(made: Articulated, folder: Path) -> Path:
    """Write it with rods that end on the axis about which their bar turns."""
    B, hinge, own = made.B.copy(), made.inside[0], made.body == 1
    B[own] = HOME + hinge.point + np.linspace(-0.05, 0.05, own.sum())[:, None] * hinge.axis
    return replace(made, B=B).write(folder)


def _with_a_motor_through_a_joint(made: Articulated, folder: Path) -> Path:
    """Write it with the axis of a motor through the joint of its rod."""
    points = made.motor_point.copy()
    points[0] = made.A[0]
    return replace(made, motor_point=points).write(folder)


def _with_a_universal_joint(made: Articulated, folder: Path) -> Path:
    """Write it with a rod that has U on its bar and S on its arm."""
    path, A, B = made.write(folder), made.A[0], made.B[0]
    urdf, bar = path.with_suffix(".urdf"), HOME + made.inside[0].point
    text = urdf.read_text()
    for name, parent, child, xyz in (
        ("leg1_a1", "bar1", "leg1_1", B - bar),
        ("leg1_a2", "leg1_1", "leg1_rod", np.zeros(3)),
        ("leg1_end_fix", "leg1_rod", "leg1_end", A - B),
        ("leg1_seat_fix", "arm1", "leg1_seat", A - made.motor_point[0]),
    ):
        joint = re.search(rf'<joint name="{name}".*?</joint>', text)
        assert joint is not None
        moved = re.sub('parent link="[^"]*"', f'parent link="{parent}"', joint[0])
        moved = re.sub('child link="[^"]*"', f'child link="{child}"', moved)
        at = " ".join(repr(float(x)) for x in xyz)
        text = text.replace(joint[0], re.sub('xyz="[^"]*"', f'xyz="{at}"', moved, count=1))
    text = re.sub('<joint name="leg1_a3".*?</joint>|<link name="leg1_2"></link>', "", text)
    urdf.write_text(text)
    return path


def _as_four_arms_of_a_delta(_: Articulated, folder: Path) -> Path:
    """Write a platform of one body on exact parallelograms."""
    made = machine("i4", turning=False)
    return replace(made, inside=(), body=np.zeros_like(made.body)).write(folder)


@pytest.mark.parametrize(
    ("written", "named"),
    [
        (_as_four_arms_of_a_delta, r"overconstrained \(1 of the 4 .* with joints at A that move"),
        (_without_motor, "no motor on the base that moves its joint at A"),
        (_with_a_universal_joint, "'hinge1', and found a joint U at its end"),
        (_with_two_joints_in_a_row, "more than the internal joint 'lift' .* needed one"),
        (_with_more_motors, "5 motors for the 4 freedoms .* no more motors than freedoms"),
        (_with_rods_on_the_hinge, "the joint 'hinge1' inside the platform moves no rod at home"),
        (_with_a_motor_through_a_joint, "'motor1' .* joint at A on the axis of the motor"),
    ],
)
def test_machines_outside_the_class_are_refused(
    written: Callable[[Articulated, Path], Path], named: str, tmp_path: Path
) -> None:
    path = written(machine("h4", turning=True), tmp_path)
    with pytest.raises(OutOfClass, match=named):
        load_mechanism(path)


# --- what can be identified ---------------------------------------------------------------------


@pytest.mark.parametrize(("kind", "turning"), thinned(KINDS, [("i4", False)]))
def test_counts_and_ranks_are_those_of_closure_and_outlines(
    kind: str, turning: bool, loaded: Loaded
) -> None:
    found = loaded(kind, turning)
    raw, free, rank_found = determined(kind, turning, radii=False)
    n_zeros = len(found.internal_joints)
    assert raw == len(parametrization_of(found)) + 12 == COUNTS[kind, turning][0]
    full = Analysis(planned_observations(found, [range(8)], 15)).full
    assert (full.of, full.rank) == (free - 12 - n_zeros, rank_found)
    assert rank_found == COUNTS[kind, turning][1]


@pytest.mark.parametrize(("kind", "turning"), thinned(KINDS, [("i4", True)]))
def test_free_radii_leave_open_the_scale_of_machines_whose_motors_turn(
    kind: str, turning: bool, loaded: Loaded
) -> None:
    known, free = (determined(kind, turning, radii=radii)[2] for radii in (False, True))
    assert known - free == int(turning)
    assert is_scale_open(Analysis(planned_observations(loaded(kind, turning), [range(8)], 15))) == (
        turning
    )


@pytest.mark.slow
def test_counts_are_those_of_the_joints_on_each_body(loaded: Loaded) -> None:
    found = loaded("h4", False)
    on = [None if leg.internal is None else leg.internal.joint for leg in found.legs]
    one = [j for j, joint in enumerate(on) if joint == "hinge1"]
    views = (one, [j for j in range(8) if j not in one])
    for n_views, distances in ((1, 6), (2, 12)):
        predicted = planned_observations(found, views[:n_views])
        conditions = {c.name: c for c in conditions_of(found, predicted)}
        assert conditions["every_leg_seen"].ok == (n_views == 2)
        assert conditions["eq15"].equations == conditions["eq17"].equations == distances
        assert conditions["eq17"].unknowns == 2 * (3 * 4 - 6)
        assert Analysis(predicted).full.complete == (n_views == 2)


# --- what does not work yet ---------------------------------------------------------------------


def test_identify_says_that_they_are_not_calibrated(loaded: Loaded) -> None:
    found = loaded("i4", False)
    report = identifiability(found, [found.leg_names], 4)
    assert any("does not calibrate it yet" in note for note in report.notes)


@pytest.mark.parametrize(
    "command",
    [
        ["simulate", "-o"],
        ["plan", "-o"],
        ["export", "--to", "urdf", "-o"],
        ["evaluate"],
    ],
    ids=lambda command: command[0],
)
def test_other_commands_refuse_them_and_say_what_works(
    command: list[str],
    loaded: Loaded,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = loaded("h4", True).yaml_path
    name, *options = command
    last = path if name == "evaluate" else tmp_path / "out"
    assert run(monkeypatch, name, path, *options, last) == OutOfClass.exit_code
    err = " ".join(capsys.readouterr().err.split())
    assert "does not calibrate them yet" in err
    assert "'hinge1' and 'hinge2'" in err
    assert "inspect and identify work" in err


def test_datasets_of_them_are_refused(tmp_path: Path) -> None:
    example = Path(__file__).resolve().parents[1] / "examples" / "hexapod"
    for name in ("measurements.csv", "camera_info.yaml"):
        (tmp_path / name).write_bytes((example / name).read_bytes())
    text = (example / "dataset.yaml").read_text()
    assert "mechanism: models/hexapod.yaml" in text
    (tmp_path / "dataset.yaml").write_text(text.replace("models/hexapod.yaml", "models/r.yaml"))
    machine("i4", turning=True).write(tmp_path / "models")
    with pytest.raises(OutOfClass, match=r"does not calibrate them yet: found the joint 'slide'"):
        load_dataset(tmp_path)


def test_machines_of_one_body_are_not_refused(loaded: Loaded) -> None:
    found = loaded("h4", True)
    rigid = replace(found, legs=tuple(replace(leg, internal=None) for leg in found.legs))
    assert rigid.require_rigid_platform() is rigid
