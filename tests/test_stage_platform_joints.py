"""Step 4: eq (16), and its rigid replacement."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from staged_hexapods import exact_session, five_millimetres_away

from legcal.errors import NotIdentifiable
from legcal.machine import KinematicParameters
from legcal.paper.four_steps import run_steps
from legcal.paper.joints_in_base import JointsInBase, locate_joints_in_base
from legcal.paper.joints_in_camera import JointsInCamera, locate_joints_in_cameras
from legcal.paper.leg_directions import LegDirections, directions_through_joints
from legcal.paper.nominal import Criteria, NominalMachine
from legcal.paper.offsets import Offsets, identify_offsets
from legcal.paper.platform import PlatformJoints, locate_platform_joints
from legcal.simulation.hexapod import (
    HexapodSession,
    PaperHexapod,
    cameras_around,
    hexapod,
    hexapod_session,
    perturb,
)
from legcal.simulation.observe import OutlineNoise
from legcal.simulation.paper import nominal_of


@dataclass(frozen=True, eq=False)
class Before:
    """What steps 1 to 3 give."""

    machine: NominalMachine
    joints: JointsInCamera
    base: JointsInBase
    directions: LegDirections
    offsets: Offsets

    def platform(self, criteria: Criteria = "default") -> PlatformJoints:
        """Return the result of step 4."""
        known = (self.joints, self.base, self.directions, self.offsets)
        return locate_platform_joints(self.machine, *known, 2e-6, criteria=criteria)


def _until_offsets(session: HexapodSession, nominal: PaperHexapod) -> Before:
    axes, measurements = session.axes, session.measurements
    machine = nominal_of(nominal)
    joints = locate_joints_in_cameras(machine, axes, measurements)
    base = locate_joints_in_base(machine, joints)
    directions = directions_through_joints(machine, axes, measurements, joints, base)
    offsets = identify_offsets(machine, directions, measurements.sigma_q)
    return Before(machine, joints, base, directions, offsets)


@pytest.mark.parametrize("coplanar", [False, True])
def test_rigid_poses_give_exact_joints_from_five_millimetres(coplanar: bool) -> None:
    session = exact_session(coplanar=coplanar)
    nominal = five_millimetres_away(session.machine)
    platform = _until_offsets(session, nominal).platform()
    true = session.machine.parameters
    assert np.abs(platform.B_Re - true.platform_joints).max() < 1e-9
    assert np.abs(platform.q0 - true.offsets).max() < 1e-9


def test_offsets_heal_when_step_3_left_them_wrong() -> None:
    session = exact_session()
    before = _until_offsets(session, session.machine)
    wrong = replace(before.offsets, q0=before.offsets.q0 + 0.002)
    platform = replace(before, offsets=wrong).platform()
    assert np.abs(platform.q0 - session.machine.parameters.offsets).max() < 1e-9


def test_eq16_never_moves_z_from_a_coplanar_nominal_model() -> None:
    session = exact_session()
    true = session.machine.parameters.platform_joints
    nominal = hexapod()
    before = _until_offsets(session, nominal)
    literal = before.platform("literal")
    assert np.abs(literal.B_Re[:, 2]).max() < 1e-9
    assert np.abs(literal.B_Re - true).max() > 5e-4
    default = before.platform()
    assert np.abs(default.B_Re - true).max() < 1e-9


def test_eq16_accepts_a_mirror_image_that_the_rigid_criterion_corrects() -> None:
    session = exact_session()
    true = session.machine.parameters
    mirrored = true.platform_joints * np.array([1.0, 1.0, -1.0])
    nominal = replace(
        session.machine,
        parameters=KinematicParameters(true.base_joints, mirrored, true.offsets),
    )
    before = _until_offsets(session, nominal)
    literal = before.platform("literal")
    assert np.abs(literal.B_Re - mirrored).max() < 1e-6
    default = before.platform()
    assert np.abs(default.B_Re - true.platform_joints).max() < 1e-9


def test_poses_that_show_two_legs_or_one_take_part() -> None:
    session = exact_session(n_poses=8)
    axes = session.axes
    two = (axes.row % 8 == 0) & ~np.isin(axes.leg, (0, 3, 4))
    one = (axes.row % 8 == 1) & ~np.isin(axes.leg, (0, 3))
    some = replace(session, axes=axes.choose(np.flatnonzero(~two & ~one)))
    counts = np.bincount(some.axes.row)
    assert set(counts.tolist()) >= {2, 4}
    nominal = five_millimetres_away(session.machine)
    result = run_steps(nominal_of(nominal), some.axes, some.measurements)
    true = session.machine.parameters
    assert np.abs(result.parameters.platform_joints - true.platform_joints).max() < 1e-9


def test_a_passive_leg_is_located_by_its_direction_alone_as_in_eq19() -> None:
    session = exact_session()
    offsets = session.machine.parameters.offsets.copy()
    offsets[1] = np.nan
    true = session.machine.parameters
    machine = replace(
        session.machine,
        parameters=KinematicParameters(true.base_joints, true.platform_joints, offsets),
    )
    q = session.measurements.q.copy()
    q[:, 1] = np.nan
    nominal = five_millimetres_away(machine)
    result = run_steps(nominal_of(nominal), session.axes, replace(session.measurements, q=q))
    assert np.abs(result.parameters.platform_joints - true.platform_joints).max() < 1e-9
    assert np.isnan(result.parameters.offsets).tolist() == [False, True] + 4 * [False]


def test_a_constant_length_leg_gets_its_length_as_offset() -> None:
    rng = np.random.default_rng(0)
    drawn = perturb(hexapod(), rng, 0.002)
    travel, offsets = drawn.travel.copy(), drawn.parameters.offsets.copy()
    travel[5] = offsets[5] = 0.4137
    A, B = drawn.parameters.base_joints, drawn.parameters.platform_joints
    machine = replace(drawn, travel=travel, parameters=KinematicParameters(A, B, offsets))
    session = hexapod_session(
        machine, cameras_around(machine, rng), rng, noise=OutlineNoise(), noisy=False, n_poses=6
    )
    assert np.abs(session.measurements.q[:, 5]).max() < 1e-12
    result = run_steps(
        nominal_of(five_millimetres_away(machine)), session.axes, session.measurements
    )
    assert result.parameters.offsets[5] == pytest.approx(0.4137, abs=1e-9)


def test_no_two_legs_at_once_is_refused() -> None:
    session = exact_session()
    before = _until_offsets(session, session.machine)
    directions = before.directions
    names = ("group", "view", "leg", "A", "u", "basis", "covariance", "reading")
    alone = LegDirections(**{n: getattr(directions, n)[directions.leg == 0] for n in names})
    with pytest.raises(NotIdentifiable, match="no pose shows two legs at once"):
        replace(before, directions=alone).platform()


def test_a_joint_that_is_seen_in_pairs_only_is_refused_by_name() -> None:
    session = exact_session()
    before = _until_offsets(session, session.machine)
    directions = before.directions
    pair = np.isin(directions.group, directions.group[directions.leg == 5])
    keep = ~pair | np.isin(directions.leg, (4, 5))
    names = ("group", "view", "leg", "A", "u", "basis", "covariance", "reading")
    some = LegDirections(**{n: getattr(directions, n)[keep] for n in names})
    with pytest.raises(NotIdentifiable, match="leg6"):
        replace(before, directions=some).platform()
