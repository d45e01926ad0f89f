"""``legcal.locate``: what poses of real machines determine, wrong rows, mistakes, refusals."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from located import (
    BASE,
    SIGMA_ANGLE,
    SIGMA_POSITION,
    TOOL,
    Located,
    located,
    motion_error,
    shipped,
)
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import locate
from legcal.calibration.location.result import ToolPoses
from legcal.errors import DatasetError, DidNotConverge, NotIdentifiable, UsageError
from legcal.geometry import rotation_matrices
from legcal.geometry.types import Array


def near_home(name: str, steps: Array) -> list[RigidTransform]:
    """Return poses displaced and turned from home, (n, 6) [m, rad]."""
    home = shipped(name).home
    return [
        RigidTransform.from_components(
            home.translation + step[:3], Rotation.from_rotvec(step[3:]) * home.rotation
        )
        for step in steps
    ]


def steps(n: int, size: float, turn: tuple[float, float, float]) -> Array:
    chance = np.random.default_rng(2)
    moves = chance.uniform(-size, size, (n, 3))
    return np.hstack([moves, chance.uniform(-0.2, 0.2, (n, 3)) * np.array(turn)])


@pytest.mark.parametrize(
    "name", ["hexapod", *(pytest.param(n, marks=pytest.mark.slow) for n in ("3-rps", "tricept"))]
)
def test_base_and_tool_are_found_as_well_as_is_said(name: str) -> None:
    made = located(name)
    found = locate(made.machine, made.poses)
    error = np.concatenate(
        [motion_error(found.T_world_base, BASE), motion_error(found.T_platform_tool, TOOL)]
    )
    assert found.status == "located"
    assert found.held == ()
    assert error @ np.linalg.solve(found.covariance, error) < 33.0  # chi2 of 12 at 0.1 %
    assert found.noise.position == pytest.approx(SIGMA_POSITION, rel=0.35)
    assert found.noise.angle == pytest.approx(SIGMA_ANGLE, rel=0.35)
    assert all(row.used for row in found.rows)
    assert found.p_value is None


@pytest.mark.parametrize("name", ["hexapod", pytest.param("3-upu", marks=pytest.mark.slow)])
def test_exact_poses_give_exact_frames_and_the_measured_poses_again(name: str) -> None:
    made = located(name, 8, noise=0.0)
    found = locate(made.machine, made.poses, tool_position=TOOL.translation.tolist())
    assert np.abs(motion_error(found.T_world_base, BASE)).max() < 1e-8
    assert np.abs(motion_error(found.T_platform_tool, TOOL)).max() < 1e-8
    assert found.rms_position < 1e-9


def test_a_machine_that_only_translates_gets_what_is_determined_and_a_sentence_on_the_rest() -> (
    None
):
    made = located("3-upu", 10)
    found = locate(made.machine, made.poses)
    assert found.status == "located in part"
    assert "the platform of this machine does not turn" in found.sentence
    (tool,) = [held for held in found.held if held.frame == "tool"]
    assert (tool.kind, len(tool.directions)) == ("position", 3)
    np.testing.assert_allclose(found.T_platform_tool.translation, 0.0, atol=1e-9)
    assert np.all(found.sigma[6:9] == pytest.approx(0.0, abs=1e-12))
    for T, true, first in ((found.T_world_base, BASE, 3), (found.T_platform_tool, TOOL, 9)):
        turn = motion_error(T, true)[3:]
        assert np.all(np.abs(turn) < 5.0 * found.sigma[first : first + 3])
    for T in made.platform:
        where = found.T_world_base * T * found.T_platform_tool
        assert np.linalg.norm(motion_error(where, BASE * T * TOOL)[:3]) < 0.05e-3


def test_a_planar_machine_keeps_one_height_open() -> None:
    made = located("3-rpr", 10)
    at = (0.0, 0.0, float(TOOL.translation[2]))
    found = locate(made.machine, made.poses, tool_position=at)
    assert found.status == "located in part"
    parts = {(h.frame, h.kind): h.directions for h in found.held}
    assert set(parts) == {("base", "position"), ("tool", "position")}
    np.testing.assert_allclose(parts["tool", "position"], [[0.0, 0.0, 1.0]], atol=1e-6)
    error = np.concatenate(
        [motion_error(found.T_world_base, BASE), motion_error(found.T_platform_tool, TOOL)]
    )
    assert abs(error[8]) < 1e-12  # held at its true value
    kept = np.delete(np.arange(12), 8)
    part = found.covariance[np.ix_(kept, kept)]
    assert error[kept] @ np.linalg.solve(part, error[kept]) < 31.3


def test_positions_alone_find_all_but_the_orientation_of_the_tool() -> None:
    made = located("hexapod")
    only = replace(made.poses, oriented=np.zeros(20, dtype=np.bool_))
    found = locate(made.machine, only)
    assert not found.has_tool_orientation
    assert found.noise.angle is None
    assert "its position only" in found.sentence
    error = np.concatenate(
        [motion_error(found.T_world_base, BASE), motion_error(found.T_platform_tool, TOOL)[:3]]
    )
    assert error @ np.linalg.solve(found.covariance[:9, :9], error) < 27.9
    assert np.all(found.covariance[9:] == 0.0)


@pytest.mark.parametrize("stated", [(None, None), (SIGMA_POSITION, SIGMA_ANGLE)])
def test_wrong_rows_are_named_and_left_out(stated: tuple[float | None, float | None]) -> None:
    made = located("hexapod")
    position = made.poses.position.copy()
    position[6] += 1e-3
    position[[2, 11]] = position[[11, 2]]
    found = locate(
        made.machine,
        replace(made.poses, position=position),
        position_sigma=stated[0],
        angle_sigma=stated[1],
    )
    assert [row.row for row in found.rows if not row.used] == [3, 7, 12]
    assert found.trustworthy
    assert "Rows 3, 7, 12 disagree with the others and were left out" in found.sentence
    assert found.rows[6].reason.startswith("1.7")
    assert np.abs(motion_error(found.T_world_base, BASE)[:3]).max() < 0.2e-3


def test_right_rows_are_not_left_out_for_what_is_stated_of_the_measurement() -> None:
    made = located("hexapod", 6)
    found = locate(made.machine, made.poses, position_sigma=1e-6, angle_sigma=1e-6)
    assert all(row.used for row in found.rows)
    assert found.status == "doubtful"
    assert not found.trustworthy
    assert "times as much as was stated" in found.sentence


def test_stated_sigmas_are_taken_and_tested() -> None:
    made = located("hexapod", 8)
    found = locate(made.machine, made.poses, position_sigma=SIGMA_POSITION, angle_sigma=SIGMA_ANGLE)
    assert found.noise.position == pytest.approx(SIGMA_POSITION)
    assert found.p_value is not None
    assert found.p_value > 1e-3
    assert found.dof == 36
    wide = locate(made.machine, made.poses, position_sigma=1e-3, angle_sigma=SIGMA_ANGLE)
    assert any("look too large: positions" in note for note in wide.notes)


def test_errors_of_readings_make_the_answer_less_certain() -> None:
    made = located("hexapod", 8)
    without, beside = (
        locate(
            made.machine,
            made.poses,
            position_sigma=SIGMA_POSITION,
            angle_sigma=SIGMA_ANGLE,
            encoder_sigma=sigma,
        )
        for sigma in (0.0, 50e-6)
    )
    assert np.all(beside.sigma > without.sigma)
    assert beside.noise.reading == 50e-6


def test_what_is_known_badly_is_named() -> None:
    made = located("hexapod", platform=near_home("hexapod", steps(12, 0.02, (0.01, 0.01, 1.0))))
    found = locate(made.machine, made.poses)
    assert any(
        note.startswith("Known badly is the position of the tool in the platform along")
        for note in found.notes
    )


@pytest.mark.parametrize(
    ("turn", "size", "match"),
    [
        ((0, 0, 1), 0.02, r"the tool in the platform along \(0, 0, 1\).*all turn about one axis, "
         r"\(0, 0, 1\).*needed rotations about two axes; add poses that are tilted"),
        ((0, 0, 0), 0.02, "poses that do not turn and move in space, needed rotations about two"),
        ((0, 0, 1), 0.0, "all turn about one axis.*stay in place, needed rotations about two"),
    ],
)  # fmt: skip
def test_poses_without_two_rotation_axes_are_refused(
    turn: tuple[float, float, float], size: float, match: str
) -> None:
    made = located("hexapod", platform=near_home("hexapod", steps(10, size, turn)))
    with pytest.raises(NotIdentifiable, match=match) as refused:
        locate(made.machine, made.poses)
    assert len(refused.value.problems) == 1


def test_a_translating_machine_that_moves_along_a_line_only_is_asked_for_other_directions() -> None:
    moves = np.zeros((6, 6))
    moves[:, 2] = np.linspace(-0.03, 0.03, 6)
    made = located("3-upu", platform=near_home("3-upu", moves))
    with pytest.raises(NotIdentifiable, match="needed displacements in 3 directions"):
        locate(made.machine, made.poses)


def test_too_few_poses_are_refused() -> None:
    made = located("hexapod")
    with pytest.raises(NotIdentifiable, match="found 1 pose, needed at least 3 poses"):
        locate(made.machine, made.rows([0]))
    with pytest.raises(NotIdentifiable, match="found 5 rows at 1 different reading, needed"):
        locate(made.machine, made.rows([0] * 5))
    three = made.rows(range(3))
    only = replace(three, oriented=np.zeros(3, dtype=np.bool_))
    with pytest.raises(NotIdentifiable, match="needed at least 4 poses of which only positions"):
        locate(made.machine, only)
    found = locate(made.machine, three)
    assert any("A wrong row among the 3 poses could not have been" in n for n in found.notes)


def test_a_scatter_that_nothing_tells_is_asked_for() -> None:
    made = located("hexapod")
    one = replace(made.poses, oriented=np.arange(20) == 4)
    with pytest.raises(NotIdentifiable, match=r"orientations of 20 rows.*state.*--angle-sigma"):
        locate(made.machine, one)
    found = locate(made.machine, one, angle_sigma=SIGMA_ANGLE)
    assert found.has_tool_orientation
    assert found.sigma[9:].max() > 0.9 * SIGMA_ANGLE


def test_rows_with_too_much_scatter_for_their_number_are_refused() -> None:
    made = located("hexapod", 4)
    position = made.poses.position.copy()
    position[2] += 5e-3
    with pytest.raises(NotIdentifiable, match=r"with a scatter of .* needed more or better ones"):
        locate(made.machine, replace(made.poses, position=position))


def _millimetres(made: Located) -> ToolPoses:
    return replace(made.poses, position=1e3 * made.poses.position)


def _reordered(made: Located) -> ToolPoses:
    quaternions = Rotation.from_matrix(made.poses.rotation).as_quat()
    wrong = Rotation.from_quat(quaternions[:, [3, 0, 1, 2]]).as_matrix()
    return replace(made.poses, rotation=wrong)


def _mirrored(made: Located) -> ToolPoses:
    S = np.diag([1.0, -1.0, 1.0])
    return replace(
        made.poses, position=made.poses.position @ S, rotation=S @ made.poses.rotation @ S
    )


def _mirrored_positions(made: Located) -> ToolPoses:
    return replace(made.poses, position=made.poses.position * [1.0, 1.0, -1.0])


def _inverse(made: Located) -> ToolPoses:
    back = np.swapaxes(made.poses.rotation, 1, 2)
    there = -np.einsum("nij,nj->ni", back, made.poses.position)
    return replace(made.poses, rotation=back, position=there)


@pytest.mark.parametrize(
    ("spoil", "match"),
    [
        (_millimetres, "look like positions in millimetres.*divide x, y and z by 1000"),
        (_reordered, "quaternions in the order w, x, y, z"),
        (_mirrored, "left-handed axes, a mirror image"),
        pytest.param(
            _mirrored_positions,
            r"positions along left-handed axes \(z reversed\)",
            marks=pytest.mark.slow,
        ),
        pytest.param(_inverse, "poses of the world in the tool", marks=pytest.mark.slow),
    ],
)
def test_common_mistakes_are_told_by_name(
    spoil: Callable[[Located], ToolPoses], match: str
) -> None:
    made = located("hexapod", 6)
    with pytest.raises(DatasetError, match=match) as refused:
        locate(made.machine, spoil(made))
    assert len(refused.value.problems) == 1


def test_poses_of_other_readings_are_refused() -> None:
    made = located("hexapod", 6)
    rolled = replace(
        made.poses,
        position=np.roll(made.poses.position, 1, axis=0),
        rotation=np.roll(made.poses.rotation, 1, axis=0),
    )
    with pytest.raises(DatasetError, match=r"whatever the frames.*check that rows belong together"):
        locate(made.machine, rolled)


def test_too_many_rows_that_disagree_are_refused_and_named() -> None:
    made = located("hexapod", 12)
    chance = np.random.default_rng(7)
    position, rotation = made.poses.position.copy(), made.poses.rotation.copy()
    position[:4] += chance.normal(size=(4, 3)) * 5e-3
    rotation[:4] = rotation_matrices(0.02 * chance.normal(size=(4, 3))) @ rotation[:4]
    with pytest.raises(DatasetError, match=r"4 of 12 rows that disagree.*\(1, 2, 3, 4\)"):
        locate(made.machine, replace(made.poses, position=position, rotation=rotation))


def test_readings_that_the_machine_cannot_have_are_refused() -> None:
    made = located("hexapod", 4)
    q = made.poses.q.copy()
    q[1] = [0.0, 0.14, 0.0, 0.14, 0.0, 0.14]
    q[1, 0] = 2.0
    with pytest.raises(DidNotConverge, match=r"The tool poses: .*row 2"):
        locate(made.machine, replace(made.poses, q=q))


@pytest.mark.parametrize(
    ("numbers", "match"),
    [
        ({"position_sigma": 0.0}, "position sigma could not be used: found 0 m"),
        ({"angle_sigma": 0.5}, "angle sigma could not be used: found 0.5 rad"),
        ({"encoder_sigma": float("nan")}, "encoder sigma could not be used: found nan"),
        ({"tool_position": (0.0, 1.0)}, "tool position could not be used.*needed three numbers"),
        ({"tool_position": (0.0, 0.0, float("inf"))}, "tool position could not be used"),
    ],
)
def test_numbers_that_cannot_be_meant_are_refused(numbers: dict[str, float], match: str) -> None:
    made = located("hexapod", 4)
    with pytest.raises(UsageError, match=match):
        locate(made.machine, made.poses, **numbers)  # type: ignore[arg-type]


def test_sigmas_that_are_stated_twice_are_refused() -> None:
    made = located("hexapod", 4)
    twice = replace(made.poses, position_sigma=np.full(4, 1e-5))
    with pytest.raises(UsageError, match="found it in the column position_sigma and as an option"):
        locate(made.machine, twice, position_sigma=1e-5)


def test_a_row_that_is_stated_to_be_worse_counts_less() -> None:
    made = located("hexapod", 8)
    position = made.poses.position.copy()
    position[0] += 2e-3
    sigma = np.full(8, SIGMA_POSITION)
    sigma[0] = 2e-3
    found = locate(
        made.machine,
        replace(made.poses, position=position, position_sigma=sigma),
        angle_sigma=SIGMA_ANGLE,
    )
    assert all(row.used for row in found.rows)
    assert np.linalg.norm(motion_error(found.T_world_base, BASE)[:3]) < 0.2e-3
