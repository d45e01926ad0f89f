"""Predictions of held-out images agree with their covariance."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from fit_sessions import MachineSession, irregular_hexapod
from scipy.spatial.transform import RigidTransform

from legcal.calibration.documents import Holdout
from legcal.calibration.joint_fit.held_out import Posterior, compare_held_out
from legcal.calibration.joint_fit.variables import start_from
from legcal.data.measurements import Measurements
from legcal.data.outlines import Outlines
from legcal.geometry.types import IntArray

N_SEEDS = 2
SHARED = 0.15  # [px], the error that each edge of each leg has in all images of a view


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A fourth of the images, and a fit of the others."""

    posterior: Posterior
    measurements: Measurements
    outlines: Outlines
    poses: tuple[RigidTransform, ...]

    def compared(self) -> Holdout:
        return compare_held_out(self.posterior, self.measurements, self.outlines, self.poses)


def _of_rows(
    session: MachineSession, measurements: Measurements, outlines: Outlines, rows: IntArray
) -> tuple[Measurements, Outlines, tuple[RigidTransform, ...]]:
    """Return some of the images, each of a pose of its own, with the start of their poses."""
    m = measurements
    images = tuple(m.image[i] for i in rows.tolist())
    some = replace(m, image=images, view=m.view[rows], pose=np.arange(len(rows)), q=m.q[rows])
    poses = session.start.T_Rb_Re
    return some, outlines.at(rows), tuple(poses[k] for k in m.pose[rows].tolist())


def _held_out(session: MachineSession, seed: int) -> HeldOut:
    rng = np.random.default_rng(seed)
    noisy = session.noisy(rng)
    measurements, outlines = noisy.measurements, noisy.outlines
    edge = np.stack([measurements.view[outlines.row], outlines.leg, outlines.edge - 1])
    errors = SHARED * rng.standard_normal((3, 6, 2))
    outlines = noisy.moved(np.repeat(errors[tuple(edge)][:, None], 2, axis=1)).outlines
    is_held_out = np.arange(measurements.n_rows) % 4 == 2
    (fitted, shown, start), (held_out, kept, near) = (
        _of_rows(session, measurements, outlines, rows)
        for rows in (np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out))
    )
    begin = replace(session.start, T_Rb_Re=start)
    solution = replace(session, measurements=fitted, outlines=shown).fit(begin)
    assert max(map(abs, solution.posterior.biases.values()), default=0.0) > 0.02  # [px]
    poses = start_from(solution.legs, held_out, session.legs, (), near, "").T_Rb_Re
    return HeldOut(solution.posterior, held_out, kept, poses)


@pytest.fixture(scope="module")
def cases() -> list[HeldOut]:
    session = irregular_hexapod(12, legs_seen=5, sigma_px=0.05)
    return [_held_out(session, seed) for seed in range(N_SEEDS)]


def test_images_are_as_far_off_as_is_expected(cases: list[HeldOut]) -> None:
    found = [case.compared() for case in cases]
    assert all(one.poses == 9 for one in found)
    shown = [int(case.outlines.used.sum()) for case in cases]
    assert [one.outlines for one in found] == shown
    assert set(found[0].views) == {"c1", "c2", "c3"}
    assert sum(one.wrong for one in found) <= 1
    ratios = [(one.rms_px or 0.0) / (one.expected_px or 1.0) for one in found]
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.1)


def test_a_wrong_outline_and_a_wrong_model_are_told(cases: list[HeldOut]) -> None:
    case = cases[0]
    right, outlines = case.compared(), case.outlines
    ends, h = outlines.ends.copy(), outlines.h.copy()
    ends[3] += 5.0
    h[3] = h[5] if outlines.leg[5] != outlines.leg[3] else h[7]
    found = replace(case, outlines=replace(outlines, ends=ends, h=h)).compared()
    assert found.wrong == right.wrong + 1
    assert found.rms_px == pytest.approx(right.rms_px, rel=0.15)
    state = case.posterior.state
    first, *others = state.legs
    moved = replace(first, B=first.B + np.array([1e-3, -1e-3, 0.0]))
    wrong = replace(case.posterior, state=replace(state, legs=(moved, *others)))
    assert replace(case, posterior=wrong).compared().wrong > 10
