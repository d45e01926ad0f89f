"""Images that a fit has not seen: foretold in pixels, and at the platform, as well as it says."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.observations.measurements import Measurements
from legcal.observations.outlines import Outlines
from legcal.refinement.foretold import FittedModel, ForetoldOutlines
from legcal.refinement.held_out import Expected, HeldOut, compare_held_out
from legcal.refinement.pose_by_outlines import poses_by_outlines
from legcal.studies.outline_design import OutlineDesign, design_of
from legcal.studies.outline_session import Noise, StartErrors, draw_session

MACHINES = ("6-spu-coplanar", "3-upu-tilted", "3-rpr")


@dataclass(frozen=True, eq=False)
class Truth:
    """Simulated images, and the model that made them."""

    design: OutlineDesign
    measurements: Measurements
    outlines: Outlines
    model: FittedModel
    poses: tuple[RigidTransform, ...]


@cache
def _truth(name: str) -> Truth:
    design = design_of(name, 3, 4, 0.1)
    rng = np.random.default_rng(8)
    session = draw_session(design, Noise(), StartErrors(0.0, 0.0, 0.0, 0.0, False), rng)
    model = FittedModel(
        legs=design.legs,
        frame_legs=design.frame_legs,
        T_camera_Rb=tuple(T.inv() for T in design.T_Rb_camera),
        cameras=(design.camera,) * 3,
        radii=design.radii,
    )
    T = RigidTransform.from_components(design.t, Rotation.from_matrix(design.R))
    poses = tuple(T[k] for k in range(len(design.t)))
    return Truth(design, session.measurements, session.outlines, model, poses)


def _compared(truth: Truth, model: FittedModel, outlines: Outlines) -> HeldOut:
    parametrization = truth.design.parametrization
    none = np.zeros((len(parametrization), len(parametrization)))
    expected = Expected(parametrization, none, outlines.covariance, 4.5)
    return compare_held_out(model, truth.measurements, outlines, truth.poses, expected)


@pytest.mark.parametrize("name", MACHINES)
def test_the_true_model_foretells_images_to_their_noise(name: str) -> None:
    truth = _truth(name)
    found = _compared(truth, truth.model, truth.outlines)
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
    first = truth.model.legs[0]
    legs = (replace(first, B=first.B + np.array([1e-3, -1e-3, 0.0])), *truth.model.legs[1:])
    found = _compared(truth, replace(truth.model, legs=legs), truth.outlines)
    at_platform = found.at_platform
    assert found.wrong > 10
    assert at_platform is not None
    assert at_platform.displacement > 2.0 * at_platform.expected_displacement


@pytest.mark.parametrize("name", MACHINES)
def test_poses_by_outlines_do_not_depend_on_where_they_are_looked_for(name: str) -> None:
    truth = _truth(name)
    foretold = ForetoldOutlines(truth.model, truth.measurements, truth.outlines)
    whitening = np.linalg.inv(np.linalg.cholesky(truth.outlines.covariance))
    turn = Rotation.from_rotvec([0.0, 0.0, 0.02])
    away = RigidTransform.from_components([4e-3, -3e-3, 0.0], turn)
    near, far = (
        poses_by_outlines(truth.model, foretold, whitening, poses, 4.5)
        for poses in (truth.poses, [away * T for T in truth.poses])
    )
    assert near.known.sum() >= 7
    for k in np.flatnonzero(near.known & far.known):
        apart = near.T_Rb_Re[k].inv() * far.T_Rb_Re[k]
        sigma = np.sqrt(np.trace(near.covariance[k, 3:, 3:]))
        assert np.linalg.norm(apart.translation) < 1e-2 * sigma


def test_a_wrong_outline_is_counted_and_left_out() -> None:
    truth = _truth("6-spu-coplanar")
    outlines = truth.outlines
    ends = outlines.ends.copy()
    ends[3] += 5.0
    h = outlines.h.copy()
    h[3] = h[5] if outlines.leg[5] != outlines.leg[3] else h[7]
    found = _compared(truth, truth.model, replace(outlines, ends=ends, h=h))
    assert found.wrong == 1
    assert found.rms_px == pytest.approx(found.expected_px, rel=0.15)


def test_an_image_that_shows_one_leg_says_nothing_at_the_platform() -> None:
    truth = _truth("6-spu-coplanar")
    alone = truth.outlines.used & (truth.outlines.leg == 0)
    found = _compared(truth, truth.model, replace(truth.outlines, used=alone))
    assert len(found.displacement) == 0
    assert found.at_platform is None
    assert found.rms_px is not None


def test_no_outlines_give_no_residuals() -> None:
    truth = _truth("6-spu-coplanar")
    nothing = np.zeros(len(truth.outlines), dtype=np.bool_)
    found = _compared(truth, truth.model, replace(truth.outlines, used=nothing))
    assert (found.outlines, found.rms_px, found.at_platform) == (0, None, None)
