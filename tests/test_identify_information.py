"""The predicted observations of ``legcal identify``, against second routes."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from layouts import Layout, write_machine
from machines import MACHINES, with_round_arms
from random_legs import changed, closed_leg
from scipy.spatial.transform import Rotation
from thinned import thinned

import legcal
from legcal.calibration.identify.information import (
    INTRINSICS,
    expected_intrinsics,
    image_rows,
    intrinsics_changes,
    whitened_leg_equations,
)
from legcal.calibration.identify.predicted_observations import (
    SIGMA_PX,
    PredictedObservations,
    at_base_joints,
    at_platform_joints,
    looking_at,
    planned_observations,
)
from legcal.calibration.identify.ranks import Analysis
from legcal.calibration.identify.scale import is_scale_open
from legcal.calibration.joint_fit.parameter_choices import Choices, Prior
from legcal.errors import DidNotConverge
from legcal.estimation.square_root import compress, eliminate
from legcal.geometry.types import Array
from legcal.machine.configurations import random_postures_of_legs
from legcal.machine.equations import leg_equations as linearize_leg
from legcal.machine.kinematics import forward_kinematics_many
from legcal.machine.leg import EquationKind, LegKind
from legcal.machine.model import Machine
from legcal.machine.model_builder import create_model
from legcal.machine.parameters import geometries, moved_legs, parametrize
from legcal.machine.rods import arms_at
from legcal.vision.cylinder import outlines_of_axis

FAST = settings(deadline=None, max_examples=4)
SEEDS = st.integers(0, 2**32 - 1)
TYPES = [f"{base}{platform}" for base, platform in product("RUS", "RUS")]
STEP = 1e-6


def random_session(seed: int, n_legs: int = 4, n_views: int = 2) -> PredictedObservations:
    """Return a session of one pose with random legs of random types."""
    rng = np.random.default_rng(seed)
    R, t = Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)
    kinds = rng.choice(list(LegKind), n_legs)
    joints = rng.choice(TYPES, n_legs)
    legs = tuple(closed_leg(j, R, t, rng, LegKind(k)) for j, k in zip(joints, kinds, strict=True))
    names = tuple(f"leg{j + 1}" for j in range(n_legs))
    return PredictedObservations(
        leg_names=names,
        legs=legs,
        frame_legs=(0, 1, 2),
        parametrization=parametrize(names, legs, (0, 1, 2)),
        radius=rng.uniform(0.01, 0.05, n_legs),
        R=R[None],
        t=t[None],
        R_reached=R[None],
        t_reached=t[None],
        view=np.arange(n_views),
        pose=np.zeros(n_views, dtype=np.intp),
        seen=rng.random((n_views, n_legs)) < 0.7,
        camera=rng.normal(size=(n_views, 3)) * 5.0,
        focal=rng.uniform(800.0, 2000.0, n_views),
        sigma_q=2e-6,
        board=np.zeros(n_views, dtype=np.bool_),
    )


def turns(session: PredictedObservations) -> Array:
    return np.repeat([1.0 / session.mean_length, 1.0], 3)


def offsets_of_axes(session: PredictedObservations, step: Array, x: Array, camera: Array) -> Array:
    """Return how far each leg's axis has moved at its old ends, in a moved camera, (n, 2, 3).

    The axis is drawn in the camera's frame and cut with the planes across the old axis.
    """
    R = Rotation.from_rotvec(x[:3]).as_matrix() @ session.R[0]
    t = session.t[0] + x[3:]
    turn = Rotation.from_rotvec(camera[:3])
    padded = np.append(step, 0.0)
    moved = []
    for j, leg in enumerate(session.legs):
        new = changed(leg, padded[session.parametrization.place[j]])
        ends = [leg.A, session.R[0] @ leg.B + session.t[0]]
        A, B = (turn.inv().apply(P - camera[3:]) for P in (new.A, R @ new.B + t))
        u0 = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        moved.append([A + (B - A) * ((P - A) @ u0) / ((B - A) @ u0) - P for P in ends])
    return np.array(moved)


def leg_values(session: PredictedObservations, step: Array, x: Array) -> Array:
    """Return what all legs demand, in standard deviations, after a step of pose and parameters."""
    parameters = np.append(step, 0.0)
    R = Rotation.from_rotvec(x[:3]).as_matrix() @ session.R[0]
    values = []
    for j, leg in enumerate(session.legs):
        new = changed(leg, parameters[session.parametrization.place[j]])
        found = linearize_leg(new, R[None], (session.t[0] + x[3:])[None]).values[0]
        if leg.kind is not LegKind.PASSIVE:
            sigma = session.sigma_q if leg.kind is LegKind.ACTUATED else session.sigma_exact
            values.append(found[0] / sigma)
        values += (found[1:] * session.length[0, j] / session.sigma_exact).tolist()
    return np.array(values)


@FAST
@given(seed=SEEDS)
def test_rows_equal_finite_differences_of_axes_cut_in_the_camera_and_of_legs(seed: int) -> None:
    session = random_session(seed)
    n_p, scale = len(session.unit), turns(session)
    images, legs = image_rows(session), whitened_leg_equations(session)
    exact = np.concatenate([legs.by_pose[0], legs.by_parameters[0]], axis=1)
    ends = at_base_joints(session), at_platform_joints(session)
    gradients = np.stack([end.gradient for end in ends], 2)  # leg, end, lateral or depth
    shown, demanded = [], []
    for column in np.eye(12 + n_p):
        sides = []
        for h in (STEP, -STEP):
            x, camera, step = np.split(h * column, [6, 12])
            cut = offsets_of_axes(session, step * session.unit, x * scale, camera * scale)
            axes = np.einsum("vnekc,nec->vnek", gradients, cut).reshape(images.shape[:3])
            sides.append((axes, leg_values(session, step * session.unit, x * scale)))
        shown.append((sides[0][0] - sides[1][0]) / (2.0 * STEP))
        demanded.append((sides[0][1] - sides[1][1]) / (2.0 * STEP))
    difference = np.stack(shown, axis=-1)
    size = np.abs(difference).max(axis=(1, 2, 3), initial=1.0)[:, None, None, None]
    np.testing.assert_allclose(images / size, difference / size, atol=1e-5)
    difference = np.delete(np.stack(demanded, axis=-1), np.s_[6:12], axis=1)
    rows = np.abs(difference).max(axis=1, keepdims=True)
    np.testing.assert_allclose(exact / rows, difference / rows, atol=1e-5)


def round_arms(folder: Path) -> Machine:
    """Return a Delta whose arms are cylinders."""
    return create_model(with_round_arms("delta"), folder).machine


def test_rows_of_arms_equal_finite_differences_of_their_axes(tmp_path: Path) -> None:
    """By readings, cameras, all parameters of their motors, and their own lines."""
    machine = round_arms(tmp_path)
    session = planned_observations(machine, [range(6), range(2, 6)], 2)
    named = parametrize(machine.leg_names, session.legs, machine.frame_legs, twists=True)
    session = replace(session, parametrization=named)
    base, platform = at_base_joints(session), at_platform_joints(session)
    n, n_q, L = session.n_legs, session.q.shape[1], session.mean_length
    assert list(session.arms) == [0, 2, 4]
    assert not base.gradient[session.view == 1, n].any()  # it shows no rod on this arm

    def offsets(q: Array, camera: Array, step: Array, image: int) -> Array:
        """Return how far axes have moved at their old ends, in standard deviations, (3, 4)."""
        pose, found = session.pose[image], []
        legs = moved_legs(session.legs, named.place, step)
        ends = arms_at(legs, (session.q + q)[[pose]])
        turn = Rotation.from_rotvec(camera[:3])
        for a, there in enumerate(ends.values()):
            A, B = turn.inv().apply(there[0] - camera[3:])
            old = base.point[image, n + a], platform.point[image, n + a]
            u0 = (old[1] - old[0]) / np.linalg.norm(old[1] - old[0])
            cut = [A + (B - A) * ((P - A) @ u0) / ((B - A) @ u0) - P for P in old]
            sides = zip((base, platform), cut, strict=True)
            found.append(np.concatenate([s.gradient[image, n + a] @ c for s, c in sides]))
        return np.array(found)

    rows, h = image_rows(session)[:, n:], 1e-6
    unit = np.concatenate([np.ones(6), np.full(n_q, 1.0 / L), np.repeat([1.0 / L, 1.0], 3)])
    unit = np.concatenate([unit, session.unit])
    for image in range(len(session.view)):
        found = []
        for column in np.diag(unit):
            _, q, camera, step = np.split(column * h, [6, 6 + n_q, 12 + n_q])
            one, other = (offsets(s * q, s * camera, s * step, image) for s in (1.0, -1.0))
            found.append((one - other) / (2.0 * h))
        difference = np.stack(found, axis=-1)
        np.testing.assert_allclose(rows[image], difference, atol=1e-5 * np.abs(difference).max())


def test_arms_tell_of_motors_but_not_of_the_scale(tmp_path: Path) -> None:
    machine, bare = round_arms(tmp_path), legcal.load_mechanism("delta")
    with_arms, without = (
        Analysis(planned_observations(m, [range(6)] * 2, 15)) for m in (machine, bare)
    )
    sigma, other = (a.motion.sigma(a.information) for a in (with_arms, without))
    assert sigma is not None
    assert other is not None
    assert 0.5 * other.dX_m < sigma.dX_m < 0.9 * other.dX_m
    assert is_scale_open(with_arms)
    radii = {f"leg{j}.radius.arm{a}_link": Prior(0.008, 1e-5) for j, a in ((1, 1), (3, 2), (5, 3))}
    assert not is_scale_open(replace(with_arms, choices=Choices(priors=radii)))


def test_a_tenth_of_a_pixel_across_is_one_standard_deviation() -> None:
    session = random_session(3)
    across = at_platform_joints(session)
    for v, j in np.argwhere(session.seen):
        P, camera = across.point[v, j], session.camera[v]
        z = (P - camera) / np.linalg.norm(P - camera)  # a camera that looks at P
        lateral, depth = across.gradient[v, j]
        ends = [P, P + lateral / (lateral @ lateral)]  # moved by one standard deviation
        pixels = [session.focal[v] * (Q - camera) / ((Q - camera) @ z) for Q in ends]
        assert np.linalg.norm(pixels[1] - pixels[0]) == pytest.approx(SIGMA_PX, rel=1e-3)
        ratio = np.linalg.norm(lateral) / np.linalg.norm(depth)
        assert ratio == pytest.approx(np.linalg.norm(P - camera) / session.radius[j])


@FAST
@given(seed=SEEDS, rank=st.integers(0, 4), rows=st.integers(1, 12))
def test_elimination_keeps_what_is_said_whatever_the_own_unknowns_do(
    seed: int, rank: int, rows: int
) -> None:
    """Against projection on what the own unknowns cannot explain."""
    rng = np.random.default_rng(seed)
    left = np.linalg.qr(rng.normal(size=(3, rows, min(rows, rank))))[0]
    right = np.linalg.qr(rng.normal(size=(3, 4, min(rows, rank))))[0]
    own = left * rng.uniform(0.5, 2.0, left.shape[2]) @ np.swapaxes(right, 1, 2)
    shared = rng.normal(size=(3, rows, 5))
    found = eliminate(np.concatenate([own, shared], axis=2), 4)
    expected = np.zeros((5, 5))
    for N, J in zip(own, shared, strict=True):
        rest = J - N @ np.linalg.pinv(N, rcond=1e-10) @ J
        expected += rest.T @ rest
    for upper in (found, compress(found)):
        np.testing.assert_allclose(upper.T @ upper, expected, atol=1e-9)


@FAST
@given(seed=SEEDS, shown=st.lists(st.booleans(), min_size=3, max_size=3))
def test_views_with_a_board_have_one_camera_in_common(seed: int, shown: list[bool]) -> None:
    """Against all unknowns in one matrix, one camera for all views with a board."""
    session = replace(random_session(seed, n_views=3), board=np.array(shown))
    analysis = Analysis(session)
    images, legs, n_p = analysis.images, analysis.equations, len(session.unit)
    cameras = ["board" if board else v for v, board in enumerate(shown)]
    places = list(dict.fromkeys(cameras))
    rows = np.zeros((3, session.n_legs * 4, 6 + 6 * len(places) + n_p))
    for v, camera in enumerate(cameras):
        seen, at = images[v].reshape(-1, 12 + n_p), 6 + 6 * places.index(camera)
        rows[v, :, :6], rows[v, :, at : at + 6] = seen[:, :6], seen[:, 6:12]
        rows[v, :, 6 + 6 * len(places) :] = seen[:, 12:]
    other = np.zeros((legs.by_pose.shape[1], rows.shape[2]))
    other[:, :6], other[:, 6 + 6 * len(places) :] = legs.by_pose[0], legs.by_parameters[0]
    every = np.concatenate([other, *rows])
    own, shared = np.split(every, [every.shape[1] - n_p], axis=1)
    basis, singular, _ = np.linalg.svd(own, full_matrices=False)
    kept = basis[:, singular > 1e-3]
    rest = shared - kept @ (kept.T @ shared)
    found, scale = analysis.information, max(1.0, float(np.abs(rest).max()) ** 2)
    np.testing.assert_allclose(found.T @ found / scale, rest.T @ rest / scale, atol=1e-6)
    one = replace(session, view=session.view[:1], pose=session.pose[:1], seen=session.seen[:1],
                  camera=session.camera[:1], board=session.board[:1])  # fmt: skip
    less = Analysis(one).information
    gain = found.T @ found - less.T @ less  # a further image of a known pose takes nothing away
    size = max(1.0, float(np.linalg.norm(found.T @ found)))  # 1/m^2: less says nothing
    assert np.linalg.eigvalsh(gain)[0] > -1e-6 * size


def edges(K: Array, X: Array, u: Array) -> Array:
    """Return places (2,) of both outlines across a thin leg at the pixel where X is seen [px]."""
    h = outlines_of_axis(u[None], X[None], np.array([1e-3]))[0]
    pixel, end = ((K @ Y)[:2] / Y[2] for Y in (X, X + 1e-3 * u))
    along = (end - pixel) / np.linalg.norm(end - pixel)
    lines, normal = h @ np.linalg.inv(K), np.array([-along[1], along[0]])  # of pixels
    return np.asarray(-(lines[:, :2] @ pixel + lines[:, 2]) / (lines[:, :2] @ normal))


@FAST
@given(seed=SEEDS, number=st.integers(0, 3))
def test_intrinsics_move_outlines_as_motions_of_the_leg_do(seed: int, number: int) -> None:
    place = np.random.default_rng(seed).normal(size=(2, 3))
    camera = 15.0 * place / np.linalg.norm(place, axis=1, keepdims=True)
    session = random_session(seed)
    session = replace(session, seen=np.ones_like(session.seen), camera=camera)
    R, across = looking_at(session), at_base_joints(session)
    shift, widening = intrinsics_changes(session, across, R)
    f, step = session.focal[0], 0.1
    K = np.array([[f, 0, 512.0], [0, f, 384.0], [0, 0, 1.0]])
    other = K.copy()
    other[((0, 0), (1, 1), (0, 2), (1, 2))[number]] += step
    for j in range(session.n_legs):
        X, u = R[0].T @ (session.A[j] - session.camera[0]), R[0].T @ session.u[0, j]
        lateral = R[0].T @ across.gradient[0, j, 0]
        at, end = (K @ Y / Y[2] for Y in (X, X + 1e-4 * u))
        along = (end - at)[:2] / np.linalg.norm((end - at)[:2])
        normal = np.array([-along[1], along[0]])
        nearby = X + 1e-5 * lateral / np.linalg.norm(lateral)
        by_metre = ((K @ nearby)[:2] / nearby[2] - at[:2]) @ normal / 1e-5
        moved = ((other @ X)[:2] / X[2] - at[:2]) @ normal
        assert moved == pytest.approx(by_metre * shift[0, j, number] * step, rel=1e-3, abs=1e-9)
        widths = [np.ptp(edges(matrix, X, u)) for matrix in (K, other)]
        assert np.log(widths[1] / widths[0]) == pytest.approx(
            widening[0, j, number] * step, rel=1e-2, abs=1e-7
        )


def test_what_is_determined_does_not_depend_on_the_size_of_the_machine() -> None:
    """A thousand times as large and as far, before the same cameras: relative figures stay."""
    session, size = planned_observations(legcal.load_mechanism("3-rps"), [range(3)] * 3, 3), 1e3
    lengths = {k: size * getattr(session, k) for k in ("radius", "t", "t_reached", "camera")}
    legs = tuple(
        replace(leg, A=size * leg.A, B=size * leg.B, q0=size * leg.q0) for leg in session.legs
    )
    larger = replace(session, legs=legs, sigma_q=size * session.sigma_q, **lengths)
    one, other = Analysis(session), Analysis(larger)
    sigma = [intrinsics_sigma(["c"] * 3, each) for each in (one, other)]
    np.testing.assert_allclose(sigma[1], sigma[0], rtol=1e-3)
    singular = [np.linalg.svd(each.information, compute_uv=False) for each in (one, other)]
    np.testing.assert_allclose(size * singular[1], singular[0], rtol=1e-3)


def intrinsics_sigma(owners: list[str], analysis: Analysis) -> Array:
    a, R = analysis, looking_at(analysis.predicted)
    found = expected_intrinsics(a.predicted, a.images, a.equations, a.prior, R, owners)
    assert [camera.camera for camera in found] == list(dict.fromkeys(owners))
    sigma = [[camera.sigma[name] for name in INTRINSICS] for camera in found]
    return np.array(sigma, dtype=np.float64)


@pytest.mark.parametrize(
    "name",
    thinned(sorted(MACHINES), ["3-RPR", "3-UPU", "6-UPS", "Tricept", "hexapod with a strut"]),
)
def test_planned_poses_close_every_leg_inside_its_travel(
    name: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Pinocchio closes the loops of the nominal machine; ours is a micrometre away from it."""
    folder = tmp_path_factory.getbasetemp() / name.replace(" ", "_")
    machine = legcal.load_mechanism(write_machine(folder / "m", MACHINES[name](), Layout()))
    session = planned_observations(machine, [range(machine.n_legs)], 8)
    assert len(session.t) == 8
    for j, (leg, nominal) in enumerate(zip(session.legs, machine.legs, strict=True)):
        found = linearize_leg(leg, session.R, session.t)
        for demand, value in zip(found.kinds, found.values.T, strict=True):
            if demand is not EquationKind.LENGTH or leg.kind is LegKind.CONSTANT:
                assert np.abs(value).max() < 1e-8
        if leg.kind is not LegKind.CONSTANT:
            q = nominal.sign * (session.length[:, j] - nominal.q0)
            slack = 0.06 * (nominal.travel[1] - nominal.travel[0]) + 1e-5
            assert nominal.travel[0] - slack < q.min()
            assert q.max() < nominal.travel[1] + slack
    assert np.ptp(session.u, axis=0).max() > 0.02
    if machine.is_determined and "strut" not in name:
        q = machine.sign * (session.length - machine.q0)
        q[:, [leg.kind is LegKind.CONSTANT for leg in machine.legs]] = 0.0
        for T, R, t in zip(
            forward_kinematics_many(machine, q[:3]), session.R[:3], session.t[:3], strict=True
        ):
            T_Rb_Re = machine.T_base_Rb.inv() * T * machine.T_platform_Re
            np.testing.assert_allclose(T_Rb_Re.translation, t, atol=1e-4)
            np.testing.assert_allclose(T_Rb_Re.rotation.as_matrix(), R, atol=1e-4)


def test_poses_out_of_reach_are_refused_and_rare_ones_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    machine, rng = legcal.load_mechanism("hexapod"), np.random.default_rng(1)
    home = machine.home_of_frames
    away = np.tile([5.0, 5.0], (6, 1))
    away[0] = [0.01, 0.01]
    with pytest.raises(DidNotConverge, match="0 of 3 random poses"):
        random_postures_of_legs(geometries(machine), machine.frame_legs, home, away, 3, rng)
    monkeypatch.setattr(
        "legcal.machine.configurations._Drive.is_regular",
        lambda _self, _R, t: rng.random(len(t)) < 0.75,  # in each of five steps
    )
    assert len(planned_observations(machine, [range(6)], 60).t) == 60
