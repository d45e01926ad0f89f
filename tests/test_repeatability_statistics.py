"""Standard deviations from repeats: pooled rightly, and what they are of, in leg axes."""

from dataclasses import replace

import numpy as np
import pytest

from legcal.calibration.measurement_noise.repeatability import (
    QUANTITIES,
    AxisValues,
    Repeats,
    Sample,
    Spread,
    axis_values,
    leg_orientations,
    pool,
    sample_of,
)
from legcal.data.axes import LegAxes, axes_from_outlines, outline_derivative
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine import Cylinder, JointType, Leg, LegKind
from legcal.vision.camera import Camera
from legcal.vision.cylinder import outlines_of_axis

RADIUS = 0.012
CAMERA = Camera(
    np.array([[1000.0, 0, 510.0], [0, 1010.0, 380.0], [0, 0, 1]]),
    1024,
    768,
    np.array([-0.2, 0.05, 0.0, 0.0, 0.0]),
)


def drawn(rng: np.random.Generator, covariance: Array, n: int, factor: float = 1.0) -> Sample:
    """Repeats with a covariance ``factor**2`` times the claimed one, about any mean."""
    L = factor * np.linalg.cholesky(covariance)
    deviations = rng.normal(0.0, 5.0, len(covariance)) + rng.standard_normal((n, len(L))) @ L.T
    return sample_of(deviations, np.broadcast_to(covariance, (n, *covariance.shape)))


def pooled(samples: list[Sample]) -> Spread:
    spread = pool(samples)
    assert spread is not None
    return spread


def test_two_repeats_have_one_degree_of_freedom_and_half_their_squared_difference() -> None:
    claimed = np.full((2, 1, 1), 0.04)
    spread = pooled([sample_of(np.array([[1.0], [1.3]]), claimed)])
    assert spread.sd == pytest.approx(0.3 / np.sqrt(2.0))
    assert spread.dof == pytest.approx(1.0)
    assert spread.ratio == pytest.approx(spread.sd / 0.2)


def test_orientations_are_weighted_by_their_degrees_of_freedom() -> None:
    one = np.ones((1, 1, 1))
    few = sample_of(np.array([[0.0], [2.0]]), np.repeat(one, 2, axis=0))  # variance 2, dof 1
    many = sample_of(np.zeros((4, 1)), np.repeat(one, 4, axis=0))  # variance 0, dof 3
    spread = pooled([few, many])
    assert spread.sd == pytest.approx(np.sqrt(2.0 / 4.0))
    assert spread.dof == pytest.approx(4.0)
    assert spread.largest == pytest.approx(np.sqrt(2.0))


def test_means_that_differ_between_orientations_are_no_spread() -> None:
    claimed = np.ones((3, 1, 1))
    samples = [sample_of(np.full((3, 1), level), claimed) for level in (0.0, 7.0, -100.0)]
    assert pooled(samples).sd == 0.0


def test_nothing_found_twice_has_no_spread() -> None:
    assert pool([]) is None


@pytest.mark.parametrize("factor", [1.0, 0.4])
def test_the_range_of_the_ratio_holds_the_truth_nineteen_times_in_twenty(factor: float) -> None:
    rng = np.random.default_rng(1)
    covariances = [
        scale * np.array([[1.0, r], [r, 1.0]]) for scale, r in ((1.0, 0.9), (0.2, -0.5), (3.0, 0.0))
    ]
    inside = 0
    for _ in range(1500):
        samples = [drawn(rng, c, n, factor) for c, n in zip(covariances, (3, 2, 8), strict=True)]
        spread = pooled(samples)
        inside += spread.ratio_low < factor < spread.ratio_high
    assert 0.93 < inside / 1500 < 0.97


def axes(u: Array, M: Array, covariance: Array) -> LegAxes:
    n = len(u)
    zero = np.zeros(n, dtype=np.intp)
    square = np.broadcast_to(covariance, (n, 4, 4))
    return LegAxes(zero, zero, u, M, normal_basis(u), square)


def values_of(u: Array, M: Array, covariance: Array | None = None) -> AxisValues:
    c = np.diag([1e-4, 1e-4, 1e-5, 1e-5]) ** 2 if covariance is None else covariance
    found = axes(u / np.linalg.norm(u, axis=1, keepdims=True), M, c)
    return axis_values(found, np.ones(len(u), dtype=np.bool_), RADIUS)


def column(values: Array, name: str) -> Array:
    return np.asarray(values[..., QUANTITIES.index(name)])


def test_a_leg_that_tilts_to_the_camera_turns_by_psi_and_not_in_the_image() -> None:
    turned = np.array([[0.0, 1.0, 0.0], [0.0, np.cos(0.01), np.sin(0.01)]])
    found = values_of(turned, np.array([[0.0, 0.0, 0.9]] * 2)).values[1]
    for name in ("psi", "tilt"):
        assert column(found, name) == pytest.approx(0.01, rel=1e-4)
    for name in ("theta", "angle", "across", "depth", "x", "z"):
        assert column(found, name) == pytest.approx(0.0, abs=1e-12)


def test_a_leg_that_turns_in_the_image_turns_by_theta_and_not_to_the_camera() -> None:
    turned = np.array([[0.0, 1.0, 0.0], [-np.sin(0.01), np.cos(0.01), 0.0]])
    found = values_of(turned, np.array([[0.0, 0.0, 0.9]] * 2)).values[1]
    assert column(found, "theta") == pytest.approx(0.01)
    assert abs(column(found, "angle")) == pytest.approx(0.01, rel=1e-4)
    for name in ("psi", "tilt", "depth", "x", "z"):
        assert column(found, name) == pytest.approx(0.0, abs=1e-12)


def test_points_along_the_leg_are_the_same_axis() -> None:
    u = np.array([0.2, 0.9, 0.3]) / np.linalg.norm([0.2, 0.9, 0.3])
    M = np.array([0.1, 0.05, 0.8])
    found = values_of(np.array([u, u]), np.array([M, M + 0.03 * u]))
    np.testing.assert_allclose(found.values, 0.0, atol=1e-15)


def test_a_move_away_from_the_camera_is_depth_and_one_across_the_ray_is_across() -> None:
    u, M = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.1, 0.9])
    moved = M + np.array([[0.0, 0.0, 0.0], [0.002, 0.0, 0.0], [0.0, 0.0, 0.005]])
    found = values_of(np.array([u] * 3), moved).values
    np.testing.assert_allclose(np.abs(column(found, "across")), [0.0, 0.002, 0.0], atol=1e-15)
    np.testing.assert_allclose(column(found, "depth"), [0.0, 0.0, 0.005], atol=1e-15)
    np.testing.assert_allclose(column(found, "x"), [0.0, 0.002, 0.0], atol=1e-15)
    np.testing.assert_allclose(column(found, "z"), [0.0, 0.0, 0.005], atol=1e-15)


def test_theta_of_a_leg_that_points_up_the_image_does_not_jump_by_a_turn() -> None:
    up = np.array([[-1e-3, -1.0, 0.0], [1e-3, -1.0, 0.0]])
    found = values_of(up, np.array([[0.0, 0.0, 0.9]] * 2)).values
    assert abs(column(found, "theta")[1]) == pytest.approx(2e-3, rel=1e-3)


@pytest.mark.parametrize(
    ("slope_deg", "exists"), [(90.0, True), (20.0, True), (3.0, True), (0.05, False), (0.0, False)]
)
def test_M_LS_does_not_exist_for_a_leg_along_the_image_x_axis(
    slope_deg: float, exists: bool
) -> None:
    slope = np.radians(slope_deg)
    u = np.array([[np.cos(slope), np.sin(slope), 0.1]] * 2)
    found = values_of(u, np.array([[0.02, 0.05, 0.9]] * 2))
    assert found.has_M_LS is exists
    assert np.all(np.isfinite(found.values))


def test_M_LS_does_not_exist_where_it_may_lie_at_infinity() -> None:
    # Parallel to the plane y = 0, yet the leg's image crosses that row: at the vanishing point.
    u = np.array([[0.3, 1e-4, 0.9]] * 2)
    assert not values_of(u, np.array([[0.02, 0.05, 0.9]] * 2)).has_M_LS


def test_a_tilt_hardly_known_leaves_M_LS_in_existence() -> None:
    # The ray through M_LS is known well: the leg crosses the row of the image steeply.
    u = np.array([[0.6, 0.8, 0.0]] * 2)
    basis = normal_basis(u)[0]
    towards = basis @ np.array([0.0, 0.0, 1.0])
    covariance = np.diag([1e-5, 1e-5, 1e-5, 1e-5]) ** 2
    covariance[:2, :2] += 0.1**2 * np.outer(towards, towards)  # 6 degrees
    found = values_of(u, np.array([[0.0, 0.1, 0.9]] * 2), covariance)
    assert found.has_M_LS


def repeated_outlines(
    u: Array, M: Array, n: int, covariance: Array, seed: int, missed: int = 0
) -> tuple[Outlines, Measurements]:
    """A leg's outlines in n images with errors of a known covariance; none in the last ones."""
    rng = np.random.default_rng(seed)
    h = outlines_of_axis(u, M, RADIUS)
    along = np.array([-0.1, 0.12])
    tangent = M + along[:, None] * u
    ends = np.stack(
        [CAMERA.project(tangent - e * RADIUS * k) for e, k in zip((1, -1), h, strict=True)]
    )
    _, derivative = outline_derivative(CAMERA, h, ends)
    error = rng.standard_normal((n, 2, 2)) @ np.linalg.cholesky(covariance).T
    noisy = h + np.einsum("nek,ekx->nex", error, derivative)
    noisy /= np.linalg.norm(noisy, axis=-1, keepdims=True)
    index = np.repeat(np.arange(n, dtype=np.intp), 2)
    used = index < n - missed
    outlines = Outlines(
        row=index,
        leg=np.zeros(2 * n, dtype=np.intp),
        part=("rod",) * (2 * n),
        edge=np.tile(np.array([1, 2], dtype=np.intp), n),
        h=noisy.reshape(-1, 3),
        ends=np.tile(ends, (n, 1, 1)),
        covariance=np.broadcast_to(covariance, (2 * n, 2, 2)),
        used=used,
        reason=tuple("" if u else "no convincing pair of edges" for u in used),
        source=("detected",) * (2 * n),
    )
    zero = np.zeros(n, dtype=np.intp)
    images = tuple(f"{i}.png" for i in range(n))
    view = View("c1", CAMERA)
    return outlines, Measurements((view,), images, zero, zero, np.zeros((n, 1)), 1e-6, ("a",))


LEG = Leg(
    JointType("S"), JointType("U"), LegKind.ACTUATED, np.zeros(3), np.ones(3), 0.3,
    name="leg1", prismatic="slide", travel=(0.0, 0.1),
    cylinders=(Cylinder("rod", RADIUS, "base", 0.0, 0.3),),
)  # fmt: skip
U = np.array([0.25, -0.93, 0.27]) / np.linalg.norm([0.25, -0.93, 0.27])
AT = np.array([0.06, -0.04, 0.85])
OF_LINES = np.array([[0.04, -0.01], [-0.01, 0.09]]) * 0.05


def test_claims_that_are_true_agree_with_the_repeats_in_every_quantity() -> None:
    outlines, measurements = repeated_outlines(U, AT, 400, OF_LINES, seed=3)
    group = Repeats(0, 0, np.arange(400))
    (found,) = leg_orientations(outlines, measurements, [LEG], [group])
    assert set(found.quantities) == set(QUANTITIES)
    for name, sample in found.quantities.items():
        spread = pooled([sample])
        assert spread.dof == pytest.approx(399.0)
        assert spread.ratio == pytest.approx(1.0, abs=0.12), name
    lines = pooled(list(found.lines))
    assert lines.sd == pytest.approx(np.sqrt(np.trace(OF_LINES) / 2.0), rel=0.1)
    assert lines.claimed == pytest.approx(np.sqrt(np.trace(OF_LINES) / 2.0), rel=0.02)


def test_an_image_tells_the_angle_in_it_far_better_than_the_tilt() -> None:
    outlines, measurements = repeated_outlines(U, AT, 100, 0.01 * np.eye(2), seed=4)
    (found,) = leg_orientations(outlines, measurements, [LEG], [Repeats(0, 0, np.arange(100))])
    ratio = found.quantities["tilt"].sd / found.quantities["angle"].sd
    assert ratio == pytest.approx(np.linalg.norm(AT) / RADIUS, rel=0.3)  # distance / radius


def test_missed_detections_are_counted_and_not_used() -> None:
    outlines, measurements = repeated_outlines(U, AT, 5, OF_LINES, seed=5, missed=2)
    (found,) = leg_orientations(outlines, measurements, [LEG], [Repeats(0, 0, np.arange(5))])
    assert (found.images, found.axes, found.outlines, found.outlines_found) == (5, 3, 10, 6)
    assert {sample.dof for sample in found.quantities.values()} == {2}


@pytest.mark.parametrize("missed", [4, 5])
def test_one_detection_or_none_gives_no_spread(missed: int) -> None:
    outlines, measurements = repeated_outlines(U, AT, 5, OF_LINES, seed=5, missed=missed)
    (found,) = leg_orientations(outlines, measurements, [LEG], [Repeats(0, 0, np.arange(5))])
    assert found.axes == 5 - missed
    assert not found.quantities
    assert not found.lines


def test_repeats_in_which_different_lengths_are_used_are_compared_at_common_ends() -> None:
    outlines, measurements = repeated_outlines(U, AT, 300, OF_LINES, seed=6)
    whole = leg_orientations(outlines, measurements, [LEG], [Repeats(0, 0, np.arange(300))])[0]
    # The same lines, of which every other image shows only the half near the base: what is known
    # of the far end is less, and the claims are of other points of the line.
    ends = outlines.ends.copy()
    half = (outlines.row % 2 == 0)[:, None]
    xy = CAMERA.undistort(ends)
    ends[:, 1] = np.where(half, CAMERA.distort(xy.mean(axis=1)), ends[:, 1])
    to_half = np.array([[1.0, 0.0], [0.5, 0.5]])
    covariance = np.where(half[:, :, None], to_half @ OF_LINES @ to_half.T, outlines.covariance)
    cut = replace(outlines, ends=ends, covariance=covariance)
    mixed = leg_orientations(cut, measurements, [LEG], [Repeats(0, 0, np.arange(300))])[0]
    spread = pooled(list(mixed.lines))
    assert spread.ratio == pytest.approx(1.0, abs=0.1)
    assert spread.sd != pytest.approx(pooled(list(whole.lines)).sd, rel=1e-3)
    assert len(axes_from_outlines(cut, measurements, {"rod": RADIUS})) == 300
