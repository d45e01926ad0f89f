"""Images that a fit has not seen: foretold in pixels, and at the platform, as well as it says."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from outline_sessions import Noise, StartErrors, design_of, draw_session
from scipy.spatial.transform import RigidTransform, Rotation
from thinned import thinned

from legcal.calibration.joint_fit import held_out as pose_by_outlines
from legcal.calibration.joint_fit.held_out import (
    HeldOut,
    PosesByOutlines,
    Posterior,
    compare_held_out,
    poses_by_outlines,
)
from legcal.calibration.joint_fit.outline_errors import N_KINDS, NoiseModel, possible_biases
from legcal.calibration.joint_fit.problem import build_fit
from legcal.calibration.joint_fit.variables import Start
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.geometry import motions_of
from legcal.machine import Leg

MACHINES = ("6-spu-coplanar", "3-upu-tilted", "3-rpr")


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


def _compared(truth: Truth, posterior: Posterior, outlines: Outlines) -> HeldOut:
    return compare_held_out(posterior, truth.measurements, outlines, truth.poses, 4.5)


@pytest.mark.parametrize("name", thinned(MACHINES, ["3-upu-tilted", "3-rpr"]))
def test_the_true_model_foretells_images_to_their_noise(name: str) -> None:
    truth = _truth(name)
    found = _compared(truth, truth.posterior, truth.outlines)
    assert found.rms_px == pytest.approx(found.expected_px, rel=0.15)
    assert (found.n_images, found.outlines) == (12, int(truth.outlines.used.sum()))
    assert found.wrong <= 1
    assert set(found.rms_px_of_view) == {"c1", "c2", "c3"}
    # What is left at the platform is the noise of the outlines alone.
    assert len(found.displacement) >= 7
    squares = (found.displacement / found.expected_displacement) ** 2
    assert 0.4 < squares.mean() < 1.8
    assert 0.2 < np.mean((found.rotation / found.expected_rotation) ** 2) < 1.8


@pytest.mark.parametrize("name", MACHINES)
def test_a_wrong_model_does_not(name: str) -> None:
    truth = _truth(name)
    first, *others = truth.posterior.state.legs
    moved = replace(first, B=first.B + np.array([1e-3, -1e-3, 0.0]))
    found = _compared(truth, truth.with_legs((moved, *others)), truth.outlines)
    at_platform = found.at_platform
    assert found.wrong > 10
    assert at_platform is not None
    assert at_platform.displacement > 2.0 * at_platform.expected_displacement


@pytest.mark.parametrize("name", MACHINES)
def test_poses_by_outlines_do_not_depend_on_where_they_are_looked_for(name: str) -> None:
    truth = _truth(name)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.02])
    away = RigidTransform.from_components([4e-3, -3e-3, 0.0], turn)
    near, far = (
        _shown(truth, truth.outlines, poses)
        for poses in (truth.poses, [away * T for T in truth.poses])
    )
    assert len(near.known) >= 7
    both = np.isin(near.known, far.known)
    assert both.sum() >= 7
    for k, covariance in zip(near.known[both].tolist(), near.covariance[both], strict=True):
        apart = near.T_Rb_Re[k].inv() * far.T_Rb_Re[k]
        sigma = np.sqrt(np.trace(covariance[3:, 3:]))
        assert np.linalg.norm(apart.translation) < 2e-2 * sigma


def test_poses_that_still_move_are_not_known(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = _truth("6-spu-coplanar")
    away = RigidTransform.from_translation([4e-3, -3e-3, 0.0])
    poses = [away * T for T in truth.poses]
    assert len(_shown(truth, truth.outlines, poses).known) >= 7
    monkeypatch.setattr(pose_by_outlines, "_ROBUST_STEPS", 0)
    monkeypatch.setattr(pose_by_outlines, "_MAX_STEPS", 1)
    assert len(_shown(truth, truth.outlines, poses).known) == 0


def _shown(truth: Truth, outlines: Outlines, poses: Sequence[RigidTransform]) -> PosesByOutlines:
    predicted = truth.posterior.of_images(truth.measurements, outlines, poses)
    return poses_by_outlines(predicted, 4.5)


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


def test_an_image_that_shows_one_leg_says_nothing_at_the_platform() -> None:
    truth = _truth("6-spu-coplanar")
    alone = truth.outlines.used & (truth.outlines.leg == 0)
    found = _compared(truth, truth.posterior, replace(truth.outlines, used=alone))
    assert len(found.displacement) == 0
    assert found.at_platform is None
    assert found.rms_px is not None


def test_no_outlines_give_no_residuals() -> None:
    truth = _truth("6-spu-coplanar")
    nothing = np.zeros(len(truth.outlines), dtype=np.bool_)
    found = _compared(truth, truth.posterior, replace(truth.outlines, used=nothing))
    assert (found.outlines, found.rms_px, found.at_platform) == (0, None, None)
