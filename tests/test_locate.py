"""``legcal locate``: what poses of real machines determine, outliers, the table, files, the fit."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import run
from csv_rows import write_rows
from hexapod_example import Run
from located import (
    BASE,
    SIGMA_ANGLE,
    SIGMA_POSITION,
    TOOL,
    Located,
    frame_errors,
    frames_of,
    located,
    motion_error,
    noisy,
    pairs_at,
    shipped,
    write_poses,
)
from scipy.spatial.transform import RigidTransform, Rotation
from test_platform_error import changed
from thinned import thinned

from legcal import Location, ToolPoses, load_mechanism, load_result, locate
from legcal.calibration.location.fit import FrameFit, fit
from legcal.calibration.location.frames import (
    PosePairs,
    frames_after,
    search,
    tool_motions,
)
from legcal.calibration.location.tool_poses import PoseNoise
from legcal.errors import (
    DatasetError,
    DidNotConverge,
    LegcalError,
    NotIdentifiable,
    UsageError,
)
from legcal.geometry.motions import nearest_rotation, rotation_matrices
from legcal.geometry.types import Array
from legcal.machine.model_writer import write_model
from legcal.machine.parameters import parametrization_of

KNOWN: dict[str, Any] = {"position_sigma": SIGMA_POSITION, "angle_sigma": SIGMA_ANGLE}


def _turned_about_z() -> Located:
    """Return a hexapod measured at poses displaced from home and turned about one axis."""
    chance, home = np.random.default_rng(2), shipped("hexapod").home
    moves = chance.uniform(-0.02, 0.02, (10, 3))
    turns = chance.uniform(-0.2, 0.2, (10, 3)) * [0.0, 0.0, 1.0]
    poses = [
        RigidTransform.from_components(
            home.translation + x, Rotation.from_rotvec(w) * home.rotation
        )
        for x, w in zip(moves, turns, strict=True)
    ]
    return located("hexapod", platform=poses)


@cache
def made(name: str, n: int, noise: float = 1.0) -> Located:
    return located(name, n, noise=noise)


def frames_error(found: Location) -> Array:
    """Return the step from the truth to what was located, (12,)."""
    return np.concatenate(
        [motion_error(found.T_world_base, BASE), motion_error(found.T_platform_tool, TOOL)]
    )


def unoriented(poses: ToolPoses) -> ToolPoses:
    return replace(poses, oriented=np.zeros(len(poses), dtype=np.bool_))


def test_base_and_tool_are_found_as_well_as_is_said() -> None:
    found = locate(made("hexapod", 20).machine, made("hexapod", 20).poses)
    error = frames_error(found)
    assert (found.status, found.held, found.p_value) == ("located", (), None)
    assert error @ np.linalg.solve(found.covariance, error) < 33.0  # chi2 of 12 at 0.1 %
    assert found.noise.position == pytest.approx(SIGMA_POSITION, rel=0.35)
    assert found.noise.angle == pytest.approx(SIGMA_ANGLE, rel=0.35)
    assert all(row.used for row in found.rows)


def test_positions_alone_find_all_but_the_orientation_of_the_tool() -> None:
    found = locate(shipped("hexapod"), unoriented(made("hexapod", 20).poses))
    assert not found.has_tool_orientation
    assert found.noise.angle is None
    assert (
        found.dof
        == 60 - 9
        == locate(
            shipped("hexapod"), unoriented(made("hexapod", 20).poses), position_sigma=1e-5
        ).dof
    )
    error = frames_error(found)[:9]
    assert error @ np.linalg.solve(found.covariance[:9, :9], error) < 27.9
    assert np.all(found.covariance[9:] == 0.0)


def test_mirrored_poses_of_a_planar_machine_turn_its_base_over_and_a_note_says_so() -> None:
    right = unoriented(made("3-rpr", 8).poses)
    mirrored = replace(right, position=right.position * [-1.0, 1.0, 1.0])
    says = [
        any("mirrored" in note and "upside down" in note for note in found.notes)
        for found in (locate(shipped("3-rpr"), poses) for poses in (right, mirrored))
    ]
    assert sorted(says) == [False, True]


def test_exact_poses_give_exact_frames_where_the_open_part_is_fixed_at_its_truth() -> None:
    """A machine that only translates: held parts have no variance."""
    exact, fixed = made("3-upu", 8, 0.0), [6, 7, 8]
    found = locate(exact.machine, exact.poses, tool_position=TOOL.translation.tolist())
    assert np.abs(frames_error(found)).max() < 1e-8
    assert found.rms_position < 1e-9
    assert found.status == "located in part"
    assert np.flatnonzero(found.sigma < 1e-12).tolist() == fixed
    tools = {h.kind: h.directions for h in found.held if h.frame == "tool"}
    assert [len(d) for d in tools.values()] == [len(fixed)]
    noisy = located("3-upu", 10)
    found = locate(noisy.machine, noisy.poses, tool_position=TOOL.translation.tolist())
    kept = np.setdiff1d(np.arange(12), fixed)
    error = frames_error(found)
    assert np.abs(error[fixed]).max(initial=0.0) < 1e-9
    assert error[kept] @ np.linalg.solve(found.covariance[np.ix_(kept, kept)], error[kept]) < 33.0


def test_outliers_are_named_and_left_out() -> None:
    hexapod = made("hexapod", 20)
    position = hexapod.poses.position.copy()
    position[6] += 1e-3
    position[[2, 11]] = position[[11, 2]]
    found = locate(hexapod.machine, replace(hexapod.poses, position=position))
    assert [row.row for row in found.rows if not row.used] == [3, 7, 12]
    assert found.trustworthy
    assert "3, 7, 12" in found.sentence
    assert found.rows[6].left_out.startswith("1.7")
    assert np.abs(frames_error(found)[:3]).max() < 0.2e-3


def test_right_rows_are_not_left_out_for_what_is_stated_of_the_measurement() -> None:
    hexapod = made("hexapod", 8)
    small = locate(hexapod.machine, hexapod.poses, position_sigma=1e-6, angle_sigma=1e-6)
    assert all(row.used for row in small.rows)
    assert (small.status, small.trustworthy) == ("doubtful", False)
    right = locate(hexapod.machine, hexapod.poses, **KNOWN)
    assert right.noise.position == pytest.approx(SIGMA_POSITION)
    assert right.p_value is not None
    assert right.p_value > 1e-3
    assert right.dof == 36


def test_errors_of_a_calibrated_model_are_in_the_covariance(
    example_run: Run, tmp_path: Path
) -> None:
    """A machine that differs from its calibrated model as the result states."""
    calibrated, result = example_run.output / "calibrated.yaml", load_result(example_run.output)
    model = load_mechanism(calibrated)
    parameters = parametrization_of(model, twists=True)
    drawn = np.random.default_rng(2).multivariate_normal(
        np.zeros(len(result.names)), result.covariance
    )
    by_name = dict(zip(result.names, drawn.tolist(), strict=True))
    step = np.array([by_name.get(name, 0.0) for name in parameters.names])
    poses = located(changed(model, parameters, step, tmp_path / "true"), noise=0.05).poses
    alone = write_model(model, tmp_path / "alone")[0]  # without the result beside it
    stated = {name: 0.05 * sigma for name, sigma in KNOWN.items()}
    squares = []
    for path in (calibrated, alone):
        found = locate(load_mechanism(path), poses, **stated)
        error = frames_error(found)
        squares.append(error @ np.linalg.solve(found.covariance, error))
    assert 3.0 < squares[0] < 33.0  # chi2 of 12
    assert squares[1] > 1e3


def _hexapod(n: int, change: Callable[[ToolPoses], dict[str, Any]]) -> Located:
    """Return a hexapod some of whose measurements are changed."""
    hexapod = located("hexapod", n)
    return replace(hexapod, poses=replace(hexapod.poses, **change(hexapod.poses)))


def _displaced(p: ToolPoses) -> dict[str, Any]:
    return {"position": p.position + 5e-3 * (np.arange(len(p)) == 2)[:, None]}


def _mirrored(p: ToolPoses) -> dict[str, Any]:
    S = np.diag([1.0, -1.0, 1.0])
    return {"position": p.position @ S, "rotation": S @ p.rotation @ S}


def _w_first(p: ToolPoses) -> dict[str, Any]:
    quaternions = Rotation.from_matrix(p.rotation).as_quat()
    return {"rotation": Rotation.from_quat(quaternions[:, [3, 0, 1, 2]]).as_matrix()}


def _four_wrong(p: ToolPoses) -> dict[str, Any]:
    chance, wrong = np.random.default_rng(7), (np.arange(len(p)) < 4)[:, None]
    shift, turn = chance.normal(size=(2, len(p), 3))
    turned = rotation_matrices(0.02 * wrong * turn) @ p.rotation
    return {"position": p.position + 5e-3 * wrong * shift, "rotation": turned}


def _rolled(p: ToolPoses) -> dict[str, Any]:
    return {name: np.roll(getattr(p, name), 1, axis=0) for name in ("position", "rotation")}


def _rows(rows: list[int], *, oriented: bool = True) -> Located:
    hexapod = made("hexapod", 20)
    poses = hexapod.rows(rows)
    return replace(hexapod, poses=poses if oriented else unoriented(poses))


def _along_a_line() -> Located:
    home = shipped("3-upu").home
    shifts = [RigidTransform.from_translation([0, 0, z]) for z in np.linspace(-0.03, 0.03, 6)]
    return located("3-upu", platform=[shift * home for shift in shifts])


def _unreachable(p: ToolPoses) -> dict[str, Any]:
    far = [2.0, 0.14, 0.0, 0.14, 0.0, 0.14]
    return {"q": np.where((np.arange(len(p)) == 1)[:, None], far, p.q)}


@pytest.mark.parametrize(
    ("spoiled", "options", "kind", "named"),
    [
        (_turned_about_z, {}, NotIdentifiable,
         ("tool in the platform along (0, 0, 1)", "another axis")),
        (_along_a_line, {}, NotIdentifiable, ("displaced in another direction",)),
        (lambda: _rows([0]), {}, NotIdentifiable, ("1 pose", "3 poses")),
        (lambda: _rows([0, 1, 2], oriented=False), {}, NotIdentifiable, ("4 poses", "positions")),
        (lambda: _hexapod(20, lambda p: {"oriented": np.arange(20) == 4}), {}, NotIdentifiable,
         ("orientations of 20 rows", "--angle-sigma")),
        (lambda: _hexapod(4, _displaced), {}, NotIdentifiable, ("measure them better",)),
        (lambda: _hexapod(6, lambda p: {"position": 1e3 * p.position}), {}, DatasetError,
         ("millimetres", "1000")),
        (lambda: _hexapod(6, _w_first), {}, DatasetError, ("order w, x, y, z",)),
        (lambda: _hexapod(6, _mirrored), {}, DatasetError, ("left-handed axes", "mirror")),
        (lambda: _hexapod(8, lambda p: {"q": p.q[:, [0, 4, 2, 3, 1, 5]]}), {}, DatasetError,
         ("columns leg2_prismatic and leg5_prismatic exchanged", "swap the headers")),
        (lambda: _hexapod(6, _rolled), {}, DatasetError,
         ("whatever the frames", "rows belong together")),
        (lambda: _hexapod(12, _four_wrong), {}, DatasetError, ("4 of 12 rows", "(1, 2, 3, 4)")),
        (lambda: _hexapod(4, _unreachable), {}, DidNotConverge, ("The tool poses", "row 2")),
        (lambda: _rows([0, 1, 2]), {"angle_sigma": 0.5}, UsageError, ("angle sigma", "0.5 rad")),
        (lambda: _rows([0, 1, 2]), {"tool_position": (0.0, 0.0, float("inf"))}, UsageError,
         ("tool position",)),
    ],
)  # fmt: skip
def test_what_cannot_be_located_is_refused_with_what_is_wrong(
    spoiled: Callable[[], Located],
    options: dict[str, Any],
    kind: type[LegcalError],
    named: tuple[str, ...],
) -> None:
    given = spoiled()
    with pytest.raises(kind) as refused:
        locate(given.machine, given.poses, **options)
    assert len(refused.value.problems) == 1
    assert [word for word in named if word not in str(refused.value)] == []


def test_a_table_says_the_same_as_arrays(tmp_path: Path) -> None:
    """In any order of columns, and with orientations of some rows only."""
    hexapod, path = located("hexapod", 5), tmp_path / "poses.csv"
    rows = write_poses(path, hexapod)
    rows = [dict(reversed(list(({"name": "first"} | row).items()))) for row in rows]
    rows[2].update(qx="", qy="", qz="", qw="")
    write_rows(path, rows)
    poses = replace(
        hexapod.poses,
        oriented=np.arange(5) != 2,
    )
    read, given = (locate(hexapod.machine, x, **KNOWN) for x in (path, poses))
    np.testing.assert_allclose(read.covariance, given.covariance, rtol=1e-9)
    np.testing.assert_allclose(frames_error(read), frames_error(given), atol=1e-12)
    assert [row.rotation is None for row in read.rows] == [False, False, True, False, False]
    assert read.notes == given.notes
    short = [
        {name: f"{float(text):.4f}" if name[0] == "q" else text for name, text in row.items()}
        for row in write_poses(path, hexapod)
    ]
    write_rows(path, short)
    assert "quaternions were made unit" in locate(hexapod.machine, path, angle_sigma=1e-3).notes[0]


@pytest.fixture(scope="module")
def found() -> Location:
    return locate(shipped("hexapod"), made("hexapod", 5).poses)


def test_the_command_writes_what_it_prints_and_ends_with_1_where_it_doubts(tmp_path: Path) -> None:
    hexapod = made("hexapod", 5)
    position = hexapod.poses.position.copy()
    position[4] += 0.05
    write_poses(tmp_path / "poses.csv", hexapod, replace(hexapod.poses, position=position))
    words = ("locate", "hexapod", tmp_path / "poses.csv", "-o", tmp_path / "a.yaml")
    outcome = run(*words, "--json")
    assert outcome.code == 0
    document = outcome.document
    assert document.pop("written") == [str(tmp_path / "a.yaml")]
    assert yaml.safe_load((tmp_path / "a.yaml").read_text()) == document
    outcome = run(*words, "--tool-position", "0,0,5mm")
    assert outcome.code == 0
    assert "Row 5 was left out: 8" in outcome.said
    outcome = run(*words, "--position-sigma", "0.001mm")
    assert outcome.code == 1
    assert "Doubtful" in outcome.out
    assert yaml.safe_load((tmp_path / "a.yaml").read_text())["status"] == "doubtful"


# The fit of both frames


STATED = (np.array([SIGMA_POSITION, SIGMA_ANGLE]), (True, True))
UNKNOWN = (np.array([1e-3, 1e-2]), (False, False))


def fitted(pairs: PosePairs, noise: tuple[Array, tuple[bool, bool]] = STATED) -> FrameFit:
    return fit(pairs, search(pairs, 3).frames[0], PoseNoise(*noise))


def test_the_nearest_rotation_is_never_a_mirror() -> None:
    matrices = np.random.default_rng(1).normal(size=(20, 3, 3))
    found = nearest_rotation(matrices)
    np.testing.assert_allclose(np.linalg.det(found), 1.0)
    others = rotation_matrices(np.random.default_rng(2).normal(size=(200, 1, 3)))
    apart = np.linalg.norm(matrices - found, axis=(1, 2))
    assert np.all(apart < np.linalg.norm(matrices - others, axis=(2, 3)))


@pytest.mark.parametrize("rotvec", [[0.3, -1.0, 2.0], [np.pi, 0.0, 0.0]])
def test_moving_the_world_moves_the_base_and_nothing_else(rotvec: list[float]) -> None:
    world = RigidTransform.from_components([0.7, -0.4, 1.0], Rotation.from_rotvec(rotvec))
    pairs = noisy(pairs_at(BASE, TOOL), np.random.default_rng(5))
    R = world.rotation.as_matrix()
    before = fitted(pairs, UNKNOWN)
    after = fitted(replace(pairs, p=world.apply(pairs.p), M=R @ pairs.M), UNKNOWN)
    expected = frames_of(world, TOOL)
    expected[0] = world.as_matrix()[:3] @ np.vstack([before.frames[0], [0, 0, 0, 1]])
    expected[1] = before.frames[1]
    assert np.abs(after.frames - expected).max() < 1e-9
    turn = np.kron(np.diag([1.0, 1.0, 0.0, 0.0]), R) + np.kron(np.diag([0, 0, 1.0, 1.0]), np.eye(3))
    np.testing.assert_allclose(turn @ before.information @ turn.T, after.information, rtol=1e-5,
                               atol=1e-5 * np.abs(after.information).max())  # fmt: skip
    assert after.chi2 == pytest.approx(before.chi2, rel=1e-6)


@pytest.mark.parametrize("case", thinned(["stated", "unknown", "model"], ["unknown", "model"]))
def test_errors_are_as_large_as_the_covariance_says(case: str) -> None:
    """Monte Carlo: unknown scatter is estimated without bias, errors of the model are counted."""
    noise, runs, chance = UNKNOWN if case == "unknown" else STATED, 40, np.random.default_rng(8)
    common = 1e-3 * chance.normal(size=(12, 6, 5)) * np.repeat([1.0, 0.2], 3)[:, None]
    truth, exact = frames_of(BASE, TOOL), pairs_at(BASE, TOOL, 12)
    at_tool = tool_motions(common, truth, exact)
    squares, sigmas = [], []
    for seed in range(runs):
        chance = np.random.default_rng(seed)
        pairs, rows = noisy(exact, chance), PoseNoise(*noise)
        if case == "model":
            step = (at_tool @ chance.normal(size=(5, 1)))[..., 0]
            p, M = pairs.p + step[:, :3], rotation_matrices(step[:, 3:]) @ pairs.M
            pairs = replace(pairs, p=p, M=M)
        by_model = common if case == "model" else None
        found = fit(pairs, frames_after(truth, 1e-3 * chance.normal(size=12)), rows, by_model)
        error = frame_errors(found.frames, BASE, TOOL) / pairs.scale
        squares.append(error @ found.information @ error / 12.0)
        sigmas.append(found.noise.sigma)
        assert found.dof == 60
    # 40 x 12: one sigma is 0.065; with some 30 degrees of freedom a kind 1.07 is expected
    assert 0.85 < np.mean(squares) < (1.3 if case == "unknown" else 1.15)
    np.testing.assert_allclose(np.mean(sigmas, axis=0), STATED[0], rtol=0.06)


@pytest.mark.parametrize("k", [24, 30])
def test_poses_far_more_precise_than_the_model_are_fitted(k: int) -> None:
    """Positions are exact: their scatter is estimated as next to nothing."""
    truth, exact, chance = frames_of(BASE, TOOL), pairs_at(BASE, TOOL), np.random.default_rng(8)
    common = 2e-4 * chance.normal(size=(8, 6, k))
    step = (tool_motions(common, truth, exact) @ chance.normal(size=(k, 1)))[..., 0]
    turn = rotation_matrices(SIGMA_ANGLE * chance.normal(size=(8, 3))) @ rotation_matrices(
        step[:, 3:]
    )
    pairs = replace(exact, p=exact.p + step[:, :3], M=turn @ exact.M)
    found = fit(pairs, truth, PoseNoise(*UNKNOWN), common)
    error = frame_errors(found.frames, BASE, TOOL) / pairs.scale
    assert error @ found.information @ error < 33.0  # chi2 of 12 at 0.1 %
    assert np.abs(error).max() > 1e-6
