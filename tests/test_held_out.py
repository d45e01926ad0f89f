"""Predictions of held-out images agree with their covariance."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from fit_sessions import (
    PINHOLE,
    HexapodSession,
    disturbed_start,
    irregular_hexapod,
    noisy_outlines,
    noisy_readings,
)
from outline_sessions import Noise, StartErrors, design_of, draw_session
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import Holdout
from legcal.calibration.joint_fit.fit import refine
from legcal.calibration.joint_fit.held_out import (
    Posterior,
    compare_held_out,
)
from legcal.calibration.joint_fit.outline_errors import N_KINDS, NoiseModel, possible_biases
from legcal.calibration.joint_fit.problem import build_fit
from legcal.calibration.joint_fit.variables import Start, start_from
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.geometry.motions import motions_of
from legcal.geometry.types import IntArray
from legcal.machine.leg import Leg
from legcal.simulation.observe import moved_outlines

N_SEEDS = 2


@dataclass(frozen=True, eq=False)
class Truth:
    """Simulated images, and what somebody knows who knows everything."""

    measurements: Measurements
    outlines: Outlines
    posterior: Posterior
    poses: tuple[RigidTransform, ...]

    def with_legs(self, legs: tuple[Leg, ...]) -> Posterior:
        """Return the same with other legs."""
        return replace(self.posterior, state=replace(self.posterior.state, legs=legs))


@cache
def _truth(name: str) -> Truth:
    design = design_of(name, 3, 4, 0.1)
    rng = np.random.default_rng(8)
    session = draw_session(design, Noise(), StartErrors(0.0, 0.0, 0.0, 0.0, False), rng)
    legs = design.legs
    problem = build_fit(legs, session.measurements, session.outlines)
    cameras = tuple(T.inv() for T in design.T_Rb_camera)
    poses = motions_of(design.R, design.t)
    state = problem.begin(Start(legs.nominal, cameras, poses, "truth"))
    possible = possible_biases(problem.outlines, legs.names)
    nothing = np.zeros((problem.n_kept, problem.n_kept))
    shifts = possible.of_sizes(np.zeros(N_KINDS))
    posterior = Posterior(problem, state, shifts, NoiseModel(), nothing)
    return Truth(session.measurements, session.outlines, posterior, poses)


def _compared(truth: Truth, posterior: Posterior, outlines: Outlines) -> Holdout:
    return compare_held_out(posterior, truth.measurements, outlines, truth.poses)


@pytest.mark.parametrize("name", ["6-spu-coplanar"])
def test_the_true_model_predicts_images_to_their_noise(name: str) -> None:
    truth = _truth(name)
    found = _compared(truth, truth.posterior, truth.outlines)
    assert found.rms_px == pytest.approx(found.expected_px, rel=0.15)
    assert (found.images, found.outlines) == (12, int(truth.outlines.used.sum()))
    assert found.wrong <= 1
    assert set(found.views) == {"c1", "c2", "c3"}


@pytest.mark.parametrize("name", ["6-spu-coplanar"])
def test_a_wrong_model_does_not(name: str) -> None:
    truth = _truth(name)
    first, *others = truth.posterior.state.legs
    moved = replace(first, B=first.B + np.array([1e-3, -1e-3, 0.0]))
    found = _compared(truth, truth.with_legs((moved, *others)), truth.outlines)
    assert found.wrong > 10


def test_a_wrong_outline_is_counted_and_left_out() -> None:
    truth = _truth("6-spu-coplanar")
    outlines = truth.outlines
    ends = outlines.ends.copy()
    ends[3] += 5.0
    h = outlines.h.copy()
    h[3] = h[5] if outlines.leg[5] != outlines.leg[3] else h[7]
    found = _compared(truth, truth.posterior, replace(outlines, ends=ends, h=h))
    assert found.wrong == 1
    assert found.rms_px == pytest.approx(found.expected_px, rel=0.15)


@pytest.fixture(scope="module")
def session() -> HexapodSession:
    return irregular_hexapod(12, legs_seen=5, sigma_px=0.05)


def _held_out(session: HexapodSession, level: float, seed: int) -> Holdout:
    """Return what a fourth of the images say of a fit of the others.

    Each edge of each leg errs alike in all images of a view, by *level* [px].
    """
    rng = np.random.default_rng(seed)
    outlines, measurements = noisy_outlines(session, rng), noisy_readings(session, rng)
    view = measurements.view[outlines.row]
    edge = np.stack([view, outlines.leg, outlines.edge - 1])
    errors = level * rng.standard_normal((3, 6, 2))
    outlines = moved_outlines(outlines, PINHOLE, np.repeat(errors[tuple(edge)][:, None], 2, axis=1))
    is_held_out = np.arange(measurements.n_rows) % 4 == 2
    (fitted, shown, start), (held_out, kept, near) = (
        _of_rows(session, measurements, outlines, rows)
        for rows in (np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out))
    )
    begin = replace(disturbed_start(session), T_Rb_Re=start)
    solution = refine(session.legs, fitted, shown, begin)
    largest = max(map(abs, solution.posterior.biases.values()), default=0.0)
    assert (largest > 0.02) == (level > 0.0)  # [px]; chance may show less
    poses = start_from(solution.legs, held_out, session.legs, (), near, "").T_Rb_Re
    return compare_held_out(solution.posterior, held_out, kept, poses)


def _of_rows(
    session: HexapodSession, measurements: Measurements, outlines: Outlines, rows: IntArray
) -> tuple[Measurements, Outlines, tuple[RigidTransform, ...]]:
    """Return some of the images, each of a pose of its own, with the start of their poses."""
    m = measurements
    images = tuple(m.image[i] for i in rows.tolist())
    some = replace(m, image=images, view=m.view[rows], pose=np.arange(len(rows)), q=m.q[rows])
    poses = disturbed_start(session).T_Rb_Re
    return some, outlines.at(rows), tuple(poses[k] for k in m.pose[rows].tolist())


@pytest.mark.parametrize("level", [0.15])
def test_images_are_as_far_off_as_is_expected(session: HexapodSession, level: float) -> None:
    found = [_held_out(session, level, seed) for seed in range(N_SEEDS)]
    assert all(one.poses == 9 for one in found)
    ratios = [(one.rms_px or 0.0) / (one.expected_px or 1.0) for one in found]
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.1)
