"""A calibration board in the fit: it joins cameras, tells its errors, and must be the right one."""

from dataclasses import replace

import numpy as np
import pytest
from board_session import BOARD, SIGMA_PX, corners_of, place_of_board, with_board
from machine_session import LENS, MachineSession, machine_session

from legcal.calibration.joint_fit.choices import BOARD_SCALE, Choices, Prior
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.problem import build_fit
from legcal.calibration.joint_fit.solution import Solution
from legcal.calibration.joint_fit.variables import Start
from legcal.data.measurements import Measurements, View
from legcal.errors import DidNotConverge
from legcal.geometry.types import Array
from legcal.machine import vector_of
from legcal.vision.board import Board


def errors(session: MachineSession, solution: Solution) -> Array:
    found = solution.parametrization
    truth = vector_of(found, session.truth.legs, session.truth.legs)
    return vector_of(found, solution.legs, session.truth.legs) - truth


def in_the_hand(session: MachineSession, start: Start) -> tuple[Measurements, Start]:
    """Return the session with a camera position of its own for every image."""
    m = session.measurements
    views = tuple(View(f"hand-{i + 1}", m.views[v].camera) for i, v in enumerate(m.view.tolist()))
    cameras = tuple(start.T_camera_Rb[v] for v in m.view.tolist())
    return (
        replace(m, views=views, view=np.arange(m.n_rows)),
        replace(start, T_camera_Rb=cameras),
    )


def test_rows_of_corners_have_the_derivatives_of_finite_differences() -> None:
    session = machine_session("hexapod")
    seen, start = with_board(session, corners_of(session, seed=0))
    choices = Choices(free=frozenset({"c1.fx", "c1.k1"}))
    problem = build_fit(
        session.legs, session.measurements, session.outlines, board=seen, choices=choices
    )
    state, factor = problem.begin(start), problem.factor("corners")
    rows, index = factor.linearize(state), problem.places["corners"].index
    wide = np.zeros((len(rows.J), 2, problem.size + 1))
    for column in range(index.shape[1]):
        here = np.arange(len(index)), slice(None), index[:, column]
        wide[here] += rows.J[:, :, column]
    concerned = np.unique(index[index < problem.n_kept])
    assert {problem.named.index(name) for name in ("c1.fx", "c1.k1", BOARD_SCALE)} < {*concerned}
    for x in concerned.tolist():
        step = 1e-6 * np.eye(problem.size)[x]
        ahead, behind = (
            factor.linearize(problem.moved(state, sign * step)).r for sign in (1.0, -1.0)
        )
        slope = (ahead - behind) / 2e-6
        atol = 1e-5 * float(np.abs(slope).max())
        # What was measured moves with the camera at the derivative of the lens where it was.
        np.testing.assert_allclose(wide[..., x], slope, rtol=1e-3, atol=10.0 * atol)
    assert not rows.J_element.any()


def test_corners_are_where_the_camera_projects_them() -> None:
    session = machine_session("3-rps")
    seen, start = with_board(session, corners_of(session))
    problem = build_fit(session.legs, session.measurements, session.outlines, board=seen)
    state = problem.begin(start)
    board, rows = problem.corners, problem.factor("corners").linearize(state)
    assert len(board) == BOARD.n_corners * 3  # one for all images of a view
    in_base = start.T_Rb_board.apply(board.point)
    for v, T in enumerate(start.T_camera_Rb):
        of_view = board.view == v
        expected = LENS.project(T.apply(in_base[of_view])) - board.pixels[of_view]
        found = rows.r[of_view] * board.sigma[of_view, None]
        far = np.abs(expected).max()
        assert far > 1.0
        np.testing.assert_allclose(found, expected, atol=0.1 * far)


@pytest.mark.parametrize(
    ("name", "by_hand"), [("hexapod", False), ("3-rps", True), ("3-rpr", True)]
)
def test_a_fit_with_a_board_is_exact_without_noise(name: str, by_hand: bool) -> None:
    session = machine_session(name)
    seen, start = with_board(session, corners_of(session))
    measurements = session.measurements
    if by_hand:
        measurements, start = in_the_hand(session, start)
    solution = refine(session.legs, measurements, session.outlines, start, board=seen)
    assert np.abs(errors(session, solution)).max() < 1e-8
    assert solution.T_Rb_board is not None
    apart = place_of_board(session).inv() * solution.T_Rb_board
    assert np.linalg.norm(apart.translation) < 1e-8
    assert solution.values[BOARD_SCALE] == pytest.approx(1.0, abs=1e-8)
    assert solution.status[BOARD_SCALE] == "estimated"


def test_a_board_tells_more_than_cameras_that_know_nothing_of_each_other() -> None:
    session = machine_session("3-rps")
    measurements, outlines = session.noisy(1)
    seen, start = with_board(session, corners_of(session, seed=2))
    free = refine(session.legs, measurements, outlines, session.start)
    joined = refine(session.legs, measurements, outlines, start, board=seen)
    assert np.median(joined.sigma[: len(free.sigma)] / free.sigma) < 0.9
    assert np.sqrt(np.mean((errors(session, joined)[:12] / joined.sigma[:12]) ** 2)) < 3.0


def test_errors_of_corners_are_found_in_their_residuals() -> None:
    session = machine_session("hexapod")
    measurements, outlines = session.noisy(3)
    corners = corners_of(session, seed=4)
    claimed = [
        refine(
            session.legs,
            measurements,
            outlines,
            with_board(session, corners)[1],
            board=with_board(session, replace(corners, sigma_px=factor * corners.sigma_px))[0],
        ).sigma
        for factor in (0.2, 5.0)
    ]
    np.testing.assert_allclose(claimed[0], claimed[1], rtol=0.05)


def test_a_few_wrong_corners_do_little() -> None:
    session = machine_session("hexapod")
    measurements, outlines = session.noisy(5)
    corners = corners_of(session, seed=6)
    wrong = corners.corner % 9 == 0
    px = corners.px + np.where(wrong[:, None], [3.0, -4.0], 0.0)
    seen, start = with_board(session, corners)
    right = refine(session.legs, measurements, outlines, start, board=seen)
    bent = refine(
        session.legs,
        measurements,
        outlines,
        start,
        board=replace(seen, corners=replace(corners, px=px)),
    )
    assert np.abs((errors(session, bent) - errors(session, right)) / right.sigma[:30]).max() < 1.0
    assert {corner for _, corner in bent.rejected_corners} == {*range(0, BOARD.n_corners, 9)}
    assert any("disagree with the fit and were left out" in note for note in bent.notes)


@pytest.mark.parametrize("factor", [0.5, 1.02])
def test_a_board_of_other_dimensions_is_refused(factor: float) -> None:
    session = machine_session("hexapod")
    measurements, outlines = session.noisy(7)
    seen, start = with_board(session, corners_of(session, seed=8))
    wrong = replace(seen, board=Board("chessboard", 7, 6, factor * BOARD.side))
    with pytest.raises(DidNotConverge, match=r"board does not fit .* measure the bo") as refusal:
        refine(session.legs, measurements, outlines, start, board=wrong)
    told = float(str(refusal.value).split("found that it is ")[1].split(" times")[0])
    assert told == pytest.approx(1.0 / factor, rel=3e-3)


def test_the_size_of_a_board_can_be_left_to_the_fit_or_known_or_fixed() -> None:
    session = machine_session("hexapod")
    measurements, outlines = session.noisy(9)
    seen, start = with_board(session, corners_of(session, seed=10))
    wrong = replace(seen, board=Board("chessboard", 7, 6, 0.98 * BOARD.side))
    everything = session.legs, measurements, outlines, start
    found = refine(*everything, board=wrong, choices=Choices(free=frozenset({BOARD_SCALE})))
    assert found.values[BOARD_SCALE] == pytest.approx(1.0 / 0.98, abs=2e-3)
    known = Choices(priors={BOARD_SCALE: Prior(1.0 / 0.98, 1e-4)})
    assert refine(*everything, board=wrong, choices=known).values[BOARD_SCALE] == pytest.approx(
        1.0 / 0.98, abs=3e-4
    )
    fixed = Choices(fixed=frozenset({BOARD_SCALE}))
    held = refine(*everything, board=seen, choices=fixed)
    assert BOARD_SCALE not in held.names
    assert held.T_Rb_board is not None
    stated = Choices(priors={BOARD_SCALE: Prior(1.0, 1e-3)})
    with pytest.raises(DidNotConverge, match=rf"prior of {BOARD_SCALE} contradicts"):
        refine(*everything, board=wrong, choices=stated)


def test_corners_help_to_find_intrinsics() -> None:
    session = machine_session("hexapod")
    measurements, outlines = session.noisy(11)
    seen, start = with_board(session, corners_of(session, seed=12))
    free = Choices(free=frozenset({"c1.fx", "c1.fy"}))
    without = refine(session.legs, measurements, outlines, session.start, choices=free)
    found = refine(session.legs, measurements, outlines, start, board=seen, choices=free)
    sigma = [s.sigma[s.names.index("c1.fx")] for s in (without, found)]
    assert sigma[1] < sigma[0]
    assert abs(found.values["c1.fx"] - LENS.K[0, 0]) < 4.0 * sigma[1]


def test_rejected_corners_and_a_board_that_nobody_sees_are_left_out() -> None:
    session = machine_session("hexapod")
    corners = corners_of(session)
    none = replace(corners, used=np.zeros(len(corners), dtype=np.bool_))
    seen, start = with_board(session, none)
    solution = refine(session.legs, session.measurements, session.outlines, start, board=seen)
    assert (solution.T_Rb_board, solution.rms_corners_px) == (None, None)
    assert BOARD_SCALE not in solution.values
    assert corners.sigma_px[0] == SIGMA_PX


def test_a_size_that_little_is_known_of_is_not_doubted() -> None:
    """One view that shows the board says nothing of its size that its distance could not."""
    session = machine_session("3-rpr")
    measurements, outlines = session.noisy(13)
    corners = corners_of(session, seed=14)
    once = replace(corners, used=corners.used & (measurements.view[corners.row] == 0))
    seen, start = with_board(session, once)
    solution = refine(session.legs, measurements, outlines, start, board=seen)
    assert solution.values[BOARD_SCALE] == pytest.approx(1.0, abs=5e-3)
