"""Residuals by a second route, derivatives of all clients by differences."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from types import ModuleType
from typing import Any, NoReturn

import numpy as np
import pytest
from camera_sessions import CAMERAS, seen_corners
from dense_fit import by_differences, jacobian, projected_move, residuals
from fit_sessions import (
    BOARD,
    LENS,
    PINHOLE,
    SIGMA_PX,
    MachineSession,
    body_edges,
    corners_of,
    machine_session,
    with_board,
    with_boards,
)
from located import BASE, TOOL, frames_of, pairs_at
from scipy.spatial.transform import RigidTransform
from thinned import thinned

from legcal.calibration.joint_fit.outline_errors import N_KINDS, EdgeBiases
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.calibration.joint_fit.problem import FitProblem, build_fit
from legcal.calibration.joint_fit.variables import State
from legcal.calibration.location import fit as location_fit
from legcal.calibration.location.fit import fit
from legcal.calibration.location.tool_poses import PoseNoise
from legcal.errors import DidNotConverge
from legcal.estimation.problem import EstimationProblem, linearize
from legcal.perception import board_adjustment, view_fit
from legcal.perception.board_adjustment import adjust_board
from legcal.perception.placement import Search, group_views
from legcal.perception.view_fit import fit_view
from legcal.vision.camera import Camera, intrinsic_names
from legcal.vision.cylinder import outlines_of_axis

CARRIED = ("delta", "delta-round-arms", "3-prs")  # whose joints at A move
WITH_BODIES = "hexapod", "delta", "3-rps"
CHOICES = {
    "hexapod": Choices(
        free=frozenset({"c1.fx", "c1.cy", "c1.k1"}),
        fixed=frozenset({"leg2.offset", "leg1.radius.leg1_tube"}),
        priors={"leg1.offset": Prior(0.4, 1e-3)},
    ),
    "3-rps": Choices(priors={"leg1.base_axis.1": Prior(0.01, 2e-3)}),
    "tricept": Choices(priors={"centre.platform_axis.2": Prior(0.0, 1e-3)}),
    "3-upu-tilted": Choices(free=frozenset({"leg2.twist"})),
    "delta-round-arms": Choices(
        free=frozenset({"arm2.gain", "arm1.arm_axis.1"}),
        fixed=frozenset({"arm3.arm_axis.1", "leg3.radius.arm2_link"}),
        priors={"leg1.length": Prior(0.4, 1e-4), "arm2.arm_point.1": Prior(1e-3, 1e-3)},
    ),
    "delta": Choices(
        free=frozenset({"arm2.gain"}),
        fixed=frozenset({"arm1.axis.1"}),
        priors={"leg1.base:leg3.base": Prior(0.55, 1e-4), "leg2.length": Prior(0.4, 1e-4)},
    ),
    "3-prs": Choices(priors={"leg1.platform:leg3.platform": Prior(0.2, 1e-4)}),
}


def _session(name: str) -> MachineSession:
    n_poses = {"3-upu-tilted": 5, "delta-round-arms": 1}.get(name, 2)
    return machine_session(name, n_poses=n_poses, camera=PINHOLE if name == "3-rps" else LENS)


def _problem(name: str) -> tuple[FitProblem, State]:
    """Return a fit with every kind of measurement and variable in some machine, off the truth.

    A hexapod shows a board and has unknown intrinsics, Nategh-Agheli biases. No
    axis or radius is where it is nominal, and outlines have weights that are not alike.
    """
    session, board = _session(name), None
    start = session.start
    if name == "hexapod":
        board, start = with_boards(session, seed=0)
    problem = build_fit(
        session.legs,
        session.measurements,
        session.outlines,
        board=board,
        choices=CHOICES.get(name, Choices()),
        edges=body_edges(session) if name in WITH_BODIES else None,
    )
    n = len(problem.outlines)
    if name == "nategh-agheli":
        shift = np.random.default_rng(0).uniform(-1.0, 1.0, (n, 2, 2))
        index = np.stack([np.zeros(n, dtype=np.intp), 1 + problem.outlines.leg], axis=1)
        names = ("all", *problem.legs.names)
        kind = np.zeros(len(names), dtype=np.intp)
        problem = problem.with_biases(EdgeBiases(names, kind, np.full(N_KINDS, 0.3), index, shift))
    T = np.tril(np.random.default_rng(4).uniform(1.0, 3.0, (n, 2, 2)))
    problem = problem.with_factors(replace(problem.factor("outlines"), whitening=T))
    x = 1e-3 * np.random.default_rng(2).uniform(-1.0, 1.0, problem.size)
    return problem, projected_move(problem, problem.begin(start), x)


@pytest.mark.parametrize("camera", [PINHOLE, LENS], ids=["pinhole", "lens"])
def test_offsets_are_those_of_the_camera_s_lines_from_the_cylinder(camera: Camera) -> None:
    session = machine_session("hexapod", n_poses=2, camera=camera)
    problem = build_fit(session.legs, session.measurements, session.outlines)
    state = problem.begin(session.start)
    state = replace(state, radii=1.01 * state.radii)
    o, offsets = problem.outlines, problem.offsets(state)
    cameras, poses = state.camera_pose.motions, state.platform_pose.motions
    for i in range(0, len(o), 5):
        T = cameras[o.view[i]]
        A = T.apply(state.A[o.leg[i]])
        B = T.apply(poses[o.pose[i]].apply(state.B[o.leg[i]]))
        u = (B - A) / np.linalg.norm(B - A)
        both = outlines_of_axis(u, A, float(state.radii[o.radius[i]]))
        h = both[0 if o.epsilon[i] > 0 else 1]
        expected = camera.line_offset(np.tile(h, (2, 1)), o.feet[i])
        np.testing.assert_allclose(offsets[i], expected, rtol=0, atol=1e-9)
    assert np.abs(offsets).max() > 1.0
    linear = linearize(problem, state)
    np.testing.assert_allclose(linear.prior_r, 0.5, rtol=1e-9)  # 1 % off, known to 2 %


def test_corners_are_where_the_camera_projects_them() -> None:
    session = machine_session("3-rps", n_poses=2)
    seen, start = with_board(session, corners_of(session))
    problem = build_fit(session.legs, session.measurements, session.outlines, board=seen)
    board = problem.boards[0]
    r = linearize(problem, problem.begin(start))["corners"].r * board.sigma[:, None]
    assert len(board) == 3 * BOARD.n_corners  # one for all images of a view
    np.testing.assert_allclose(board.sigma, SIGMA_PX / np.sqrt(2))  # of two images
    in_base = start.T_Rb_board.apply(board.point)
    for v, T in enumerate(start.T_camera_Rb):
        of_view = board.view == v
        expected = LENS.project(T.apply(in_base[of_view])) - board.pixels[of_view]
        far = np.abs(expected).max()
        assert far > 1.0
        np.testing.assert_allclose(r[of_view], expected, atol=0.1 * far)


@pytest.mark.parametrize(
    "name",
    thinned(
        ["nategh-agheli", "tricept", "3-prs", "hexapod", "hexapod-rod", "delta-round-arms"],
        ["nategh-agheli", "tricept", "3-prs"],
    ),
)
def test_all_factors_have_the_derivatives_of_finite_differences(name: str) -> None:
    problem, state = _problem(name)
    assert all(map(len, problem.boards)) or name != "hexapod"
    J = jacobian(problem, linearize(problem, state))
    unit = np.eye(problem.size)
    expected = by_differences(problem, state, lambda s: residuals(problem, s), unit)
    size = np.abs(expected).max(axis=0)
    # What acts on the constraints alone: axes, twists, constant lengths.
    idle = [problem.named[i] for i in np.flatnonzero(size[: problem.n_named] == 0.0)]
    assert all("axis" in n or n.endswith((".twist", ".length")) or name in CARRIED for n in idle)
    # Differences of an angle with a prior are rounded by 1e-16 rad over its sigma and the step.
    assert np.abs((J - expected) / np.maximum(size, 0.1)).max() < 1e-6


def _board(free: tuple[str, ...] = (), model: str = "plumb_bob") -> None:
    camera = CAMERAS[model]
    seen = seen_corners(camera, 3, 1)
    start = RigidTransform.from_translation([-0.12, -0.08, 0.4])
    adjust_board(camera, [start] * 3, seen, free or (), max_iterations=3)


def _tool_poses() -> None:
    pairs, noise = pairs_at(BASE, TOOL), PoseNoise(np.ones(2), (True, True))
    by_model = np.random.default_rng(0).normal(size=(8, 6, 4))
    fit(pairs, frames_of(BASE, TOOL), noise, by_model)


def _view_of_outlines() -> None:
    session = machine_session("3-rps", n_poses=2)
    m, start = session.measurements, session.start
    A, B = (np.array([getattr(leg, end) for leg in start.legs]) for end in "AB")
    ends = np.array([T.apply(B) for T in start.T_Rb_Re])
    every = np.ones((len(m.views), len(A)), dtype=np.bool_)
    cylinders = [leg.cylinders for leg in start.legs]
    size = float(np.linalg.norm(ends[0] - A, axis=1).mean())
    A_of_rows = np.broadcast_to(A, ends.shape)
    search = Search(_no_image, m, A_of_rows, ends, cylinders, every, m.image, size)
    rough = [T.inv() for T in start.T_camera_Rb]
    to_first = [start.T_camera_Rb[0] * T for T in rough]  # two cameras on one mount
    (group, _) = group_views(m, np.arange(m.n_rows), rough, [*to_first[:2], None])
    fit_view(search, group, rough[0], np.zeros((len(A), 2, 3)), session.outlines)


def _no_image(row: int) -> NoReturn:
    raise AssertionError(f"image {row} was opened")


CLIENTS: dict[str, tuple[ModuleType, Callable[[], None]]] = {
    "board before a known camera": (board_adjustment, _board),
    **{
        f"board before an unknown camera, {model}": (
            board_adjustment,
            partial(_board, intrinsic_names(camera), model),
        )
        for model, camera in CAMERAS.items()
    },
    "tool poses with errors of the model": (location_fit, _tool_poses),
    "camera by the outlines of its views": (view_fit, _view_of_outlines),
}


@pytest.mark.parametrize("client", CLIENTS)
def test_problems_of_other_clients_have_them_too(
    client: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    module, run = CLIENTS[client]
    seen: list[tuple[EstimationProblem[Any], Any]] = []

    entry = "minimise" if hasattr(module, "minimise") else "linearize"  # with steps of its own
    unwatched = getattr(module, entry)

    def watched(problem: EstimationProblem[Any], state: Any, *more: Any, **options: Any) -> Any:
        seen.append((problem, state))
        return unwatched(problem, state, *more, **options)

    monkeypatch.setattr(module, entry, watched)
    run()
    problem, state = seen[0]
    J = jacobian(problem, linearize(problem, state))
    expected = by_differences(problem, state, lambda s: residuals(problem, s), np.eye(problem.size))
    size = np.abs(expected).max(axis=0)
    assert np.all(size > 0.0)
    assert np.abs((J - expected) / size).max() < 1e-5


def test_poses_that_do_not_come_to_rest_on_their_constraints_are_refused() -> None:
    session = _session("3-rps")
    problem = build_fit(session.legs, session.measurements, session.outlines)
    far = 0.3 * np.random.default_rng(13).normal(size=problem.size)
    far[problem.n_kinematic : problem.n_kept] = 0.0
    with pytest.raises(DidNotConverge, match=r"a pose did not converge \(last step \d"):
        problem.projected(problem.moved(problem.begin(session.start), far))
