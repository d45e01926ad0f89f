"""Measurement noise from repeated images (4.2): statistics, axes, Canny, the command."""

import json
from collections.abc import Callable
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command_line import run
from rendering import Bar, Light, RepeatedImages, render, repeated_images
from rich.console import Console
from scipy.spatial.transform import RigidTransform

from legcal import measure_noise
from legcal.calibration.measurement_noise.canny import canny_parts, edge_points
from legcal.calibration.measurement_noise.comparison import find_repeats, noise_notes
from legcal.calibration.measurement_noise.document import DatasetNoise
from legcal.calibration.measurement_noise.repeatability import (
    QUANTITIES,
    AxisValues,
    LegOrientation,
    PooledSpread,
    Repeats,
    Sample,
    axis_values,
    leg_orientations,
    pool,
    sample_of,
)
from legcal.data.axes import LegAxes, outline_derivative
from legcal.data.dataset import load_dataset
from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.errors import DatasetError, LegcalError, NotIdentifiable, NotVisible
from legcal.geometry.lines import normal_basis
from legcal.geometry.types import Array
from legcal.machine.leg import Cylinder, JointType, Leg, LegKind
from legcal.machine.loader import load_mechanism
from legcal.perception.detection import measure_outlines
from legcal.perception.outline import measure
from legcal.perception.placement import Placement, Search
from legcal.report.noise import noise_table
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON, outlines_of_axis

RADIUS = 0.012
LENS = np.array([-0.3, 0.1, 0.001, -0.002, 0.0])

# Statistics of repeats


def pooled(samples: list[Sample]) -> PooledSpread:
    spread = pool(samples)
    assert spread is not None
    return spread


def sample(values: list[float], variance: float = 1.0) -> Sample:
    n = len(values)
    return sample_of(np.array(values)[:, None], np.full((n, 1, 1), variance))


def test_pooled_spread_of_few_repeats_by_hand() -> None:
    """Degrees of freedom weigh; means that differ between orientations are no spread."""
    assert pool([]) is None
    two = pooled([sample([1.0, 1.3], 0.04)])
    assert two.sd == pytest.approx(0.3 / np.sqrt(2.0))
    assert two.dof == pytest.approx(1.0)
    assert two.ratio == pytest.approx(two.sd / 0.2)
    both = pooled([sample([0.0, 2.0]), sample([0.0] * 4)])  # variances 2 and 0, dof 1 and 3
    assert both.sd == pytest.approx(np.sqrt(2.0 / 4.0))
    assert both.dof == pytest.approx(4.0)
    assert both.largest == pytest.approx(np.sqrt(2.0))
    assert pooled([sample([level] * 3) for level in (0.0, 7.0, -100.0)]).sd == 0.0


@pytest.mark.parametrize("factor", [1.0, 0.4])
def test_the_range_of_the_ratio_holds_the_truth_nineteen_times_in_twenty(factor: float) -> None:
    """Monte Carlo of repeats whose covariance is factor^2 times the claimed one, about any mean."""
    rng = np.random.default_rng(1)
    covariances = [
        scale * np.array([[1.0, r], [r, 1.0]]) for scale, r in ((1.0, 0.9), (0.2, -0.5), (3.0, 0.0))
    ]
    inside, runs = 0, 800
    for _ in range(runs):
        samples = []
        for C, n in zip(covariances, (3, 2, 8), strict=True):
            noise = factor * rng.standard_normal((n, 2)) @ np.linalg.cholesky(C).T
            samples.append(
                sample_of(rng.normal(0.0, 5.0, 2) + noise, np.broadcast_to(C, (n, 2, 2)))
            )
        spread = pooled(samples)
        inside += spread.ratio_low < factor < spread.ratio_high
    assert 0.925 < inside / runs < 0.975


# What repeated axes are in numbers


def values_of(u: Any, M: Any, covariance: Array | None = None) -> AxisValues:
    u = np.array(u) / np.linalg.norm(u, axis=1, keepdims=True)
    c = np.diag([1e-4, 1e-4, 1e-5, 1e-5]) ** 2 if covariance is None else covariance
    n, zero = len(u), np.zeros(len(u), dtype=np.intp)
    axes = LegAxes(zero, zero, u, np.array(M), normal_basis(u), np.broadcast_to(c, (n, 4, 4)))
    return axis_values(axes, np.ones(n, dtype=np.bool_), RADIUS)


UP, AT = [0.0, 1.0, 0.0], [0.0, 0.1, 0.9]


@pytest.mark.parametrize(
    ("u", "M", "moved"),
    [
        ([0.0, np.cos(0.01), np.sin(0.01)], [0.0, 0.0, 0.9], {"psi": 0.01, "tilt": 0.01}),
        ([-np.sin(0.01), np.cos(0.01), 0.0], [0.0, 0.0, 0.9], {"theta": 0.01, "angle": 0.01}),
        (UP, [0.0, 0.13, 0.9], {}),  # along the leg: the same axis
        (UP, [0.002, 0.1, 0.9], {"across": 0.002, "x": 0.002}),
        (UP, [0.0, 0.1, 0.905], {"depth": 0.005, "z": 0.005}),
    ],
)
def test_each_motion_of_an_axis_shows_in_its_own_quantities(
    u: list[float], M: list[float], moved: dict[str, float]
) -> None:
    start = [0.0, 0.0, 0.9] if moved.keys() & {"psi", "theta"} else AT
    found = dict(zip(QUANTITIES, values_of([UP, u], [start, M]).values[1], strict=True))
    for name, value in found.items():
        assert abs(value) == pytest.approx(moved.get(name, 0.0), rel=1e-4, abs=1e-12), name


def test_theta_of_a_leg_that_points_up_the_image_does_not_jump_by_a_turn() -> None:
    found = values_of([[-1e-3, -1.0, 0.0], [1e-3, -1.0, 0.0]], [[0.0, 0.0, 0.9]] * 2).values
    assert abs(found[1, QUANTITIES.index("theta")]) == pytest.approx(2e-3, rel=1e-3)


TOWARDS = normal_basis(np.array([[0.6, 0.8, 0.0]]))[0] @ np.array([0.0, 0.0, 1.0])
HARDLY_KNOWN = np.diag([1e-5] * 4) ** 2
HARDLY_KNOWN[:2, :2] += 0.1**2 * np.outer(TOWARDS, TOWARDS)  # a tilt known to 6 degrees


@pytest.mark.parametrize(
    ("u", "covariance", "exists"),
    [
        *(([np.cos(s), np.sin(s), 0.1], None, exists)
          for s, exists in ((1.57, True), (0.35, True), (0.05, True), (1e-3, False), (0.0, False))),
        # parallel to the plane y = 0, yet its image crosses that row: at the vanishing point
        ([0.3, 1e-4, 0.9], None, False),
        # the ray through M_LS is known well: the leg crosses the row of the image steeply
        ([0.6, 0.8, 0.0], HARDLY_KNOWN, True),
    ],
)  # fmt: skip
def test_M_LS_exists_where_the_leg_crosses_its_row(
    u: list[float], covariance: Array | None, exists: bool
) -> None:
    found = values_of([u] * 2, [[0.02, 0.05, 0.9]] * 2, covariance)
    assert found.has_M_LS is exists
    assert np.all(np.isfinite(found.values))


CAMERA = Camera(
    np.array([[1000.0, 0, 510.0], [0, 1010.0, 380.0], [0, 0, 1]]),
    1024, 768, np.array([-0.2, 0.05, 0.0, 0.0, 0.0]),
)  # fmt: skip
LEG = Leg(
    JointType.SPHERICAL, JointType.UNIVERSAL, LegKind.ACTUATED, np.zeros(3), np.ones(3), 0.3,
    name="leg1", prismatic="slide",
    travel=(0.0, 0.1), cylinders=(Cylinder("rod", RADIUS, "base", 0.0, 0.3),),
)  # fmt: skip
U = np.array([0.25, -0.93, 0.27]) / np.linalg.norm([0.25, -0.93, 0.27])
POINT = np.array([0.06, -0.04, 0.85])
OF_LINES = np.array([[0.04, -0.01], [-0.01, 0.09]]) * 0.05


def orientation(
    n: int, missed: int = 0, change: Callable[[Outlines], Outlines] = lambda outlines: outlines
) -> LegOrientation:
    """Return what a leg's outlines in n images with errors of a known covariance say."""
    rng = np.random.default_rng(3)
    h = outlines_of_axis(U, POINT, RADIUS)
    tangent = POINT + np.array([-0.1, 0.12])[:, None] * U
    ends = np.stack(
        [CAMERA.project(tangent - e * RADIUS * k) for e, k in zip((1, -1), h, strict=True)]
    )
    _, derivative = outline_derivative(CAMERA, h, ends)
    error = rng.standard_normal((n, 2, 2)) @ np.linalg.cholesky(OF_LINES).T
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
        covariance=np.broadcast_to(OF_LINES, (2 * n, 2, 2)),
        used=used,
        reason=tuple("" if u else "no convincing pair of edges" for u in used),
        source=("detected",) * (2 * n),
    )
    zero, images = np.zeros(n, dtype=np.intp), tuple(f"{i}.png" for i in range(n))
    view = View("c1", CAMERA)
    m = Measurements((view,), images, zero, zero, np.zeros((n, 1)), 1e-6, ("a",))
    (found,) = leg_orientations(change(outlines), m, [LEG], [Repeats(0, 0, np.arange(n))])
    return found


def test_claims_that_are_true_agree_with_the_repeats_in_every_quantity() -> None:
    found = orientation(400)
    assert set(found.quantities) == set(QUANTITIES)
    for name, one in found.quantities.items():
        spread = pooled([one])
        assert spread.dof == pytest.approx(399.0)
        assert spread.ratio == pytest.approx(1.0, abs=0.12), name
    lines = pooled(list(found.lines))
    assert lines.sd == pytest.approx(np.sqrt(np.trace(OF_LINES) / 2.0), rel=0.1)
    assert lines.claimed == pytest.approx(np.sqrt(np.trace(OF_LINES) / 2.0), rel=0.02)
    ratio = found.quantities["tilt"].sd / found.quantities["angle"].sd
    assert ratio == pytest.approx(np.linalg.norm(POINT) / RADIUS, rel=0.3)  # distance / radius


@pytest.mark.parametrize("missed", [2, 4, 5])
def test_missed_detections_are_counted_and_not_used(missed: int) -> None:
    found, left = orientation(5, missed), 5 - missed
    assert (found.images, found.axes, found.outlines) == (5, left, 10)
    assert found.outlines_found == 2 * left
    assert bool(found.quantities) == bool(found.lines) == (left > 1)
    assert {one.dof for one in found.quantities.values()} <= {left - 1}


def test_repeats_in_which_different_lengths_are_used_are_compared_at_common_ends() -> None:
    """Every other image shows only the half near the base: claims are of other points there."""

    def cut(outlines: Outlines) -> Outlines:
        ends, half = outlines.ends.copy(), (outlines.row % 2 == 0)[:, None]
        middle = CAMERA.distort(CAMERA.undistort(ends).mean(axis=1))
        ends[:, 1] = np.where(half, middle, ends[:, 1])
        to_half = np.array([[1.0, 0.0], [0.5, 0.5]])
        claims = np.where(half[:, :, None], to_half @ OF_LINES @ to_half.T, outlines.covariance)
        return replace(outlines, ends=ends, covariance=claims)

    mixed, whole = (pooled(list(o.lines)) for o in (orientation(300, 0, cut), orientation(300)))
    assert mixed.ratio == pytest.approx(1.0, abs=0.1)
    assert mixed.sd != pytest.approx(whole.sd, rel=1e-3)


# Canny's edge points and least squares, as the paper found outlines

FLAT = Light(ambient=1.0, diffuse=0.0)
BARS = [(-0.09, 0.03), (0.08, -0.05)]  # where they are and how far they lean [m]


def canny_errors(
    places: list[tuple[float, float]],
    distortion: Array | None = None,
    change: Callable[[Array], Array] = lambda image: image,
    **looks: Any,
) -> tuple[Outlines, Outlines, Array]:
    """Detect bars predicted 2 mm off: by Canny, by ours, and Canny's errors inwards [px]."""
    K = np.array([[700.0, 0.0, 181.3], [0.0, 707.0, 133.1], [0.0, 0.0, 1.0]])
    camera = Camera(K, 360, 270, np.zeros(0) if distortion is None else distortion)
    bars = [
        Bar(np.array([x - lean, 0.16, 0.8]), np.array([x + lean, -0.16, 0.84]), 0.011, 170.0)
        for x, lean in places
    ]
    scene: dict[str, Any] = {"light": FLAT, "blur": 0.5, "noise": 1.0, "supersample": 3, **looks}
    pixels = np.rint(change(render(camera, bars, 40.0, **scene)))
    rng, one, n = np.random.default_rng(0), np.zeros(1, dtype=np.intp), len(bars)
    A, B = (np.array([getattr(b, end) for b in bars])[None] for end in "AB")
    m = Measurements((View("c1", camera),), ("a.png",), one, one, np.zeros((1, n)), 1e-6)
    lengths = np.linalg.norm(B - A, axis=2)[0]
    cylinders = [(Cylinder("rod", 0.011, "base", 0.0, float(length)),) for length in lengths]
    A, B = (X + 2e-3 * rng.choice([-1.0, 1.0], X.shape) for X in (A, B))
    shown = np.ones((1, n), dtype=np.bool_)
    image = np.clip(pixels, 0, 255).astype(np.float32)
    names = [f"leg{i + 1}" for i in range(n)]
    search = Search(lambda row: image, m, A, B, cylinders, shown, names, float(lengths.mean()))
    placement = Placement(A, B, (RigidTransform.identity(),))
    canny, ours = (
        measure_outlines(search, placement, [0], method=method)[0]
        for method in (canny_parts, measure)
    )
    error = []
    for i in np.flatnonzero(canny.used).tolist():
        b = bars[canny.leg[i]]
        h = outlines_of_axis((b.B - b.A) / np.linalg.norm(b.B - b.A), b.A, b.radius)
        line = np.stack([h[canny.edge[i] - 1]] * 2)
        offset = camera.line_offset(line, camera.undistort(canny.ends[i]))
        error.append(EPSILON[canny.edge[i] - 1] * offset)
    return canny, ours, np.array(error)


def test_edge_points_lie_beside_a_step_on_whole_pixels() -> None:
    image = np.full((60, 80), 50.0, dtype=np.float32)
    image[:, 41:] = 120.0  # the step is between columns 40 and 41
    points = edge_points(image)
    assert set(points[:, 0]) <= {40.0, 41.0}
    assert set(points[:, 1]) == set(np.arange(60.0))


@pytest.mark.parametrize("distortion", [None, LENS], ids=["pinhole", "lens"])
def test_flat_edges_are_found_without_bias(distortion: Array | None) -> None:
    """Both methods look at the same parts; rounding to whole pixels is claimed."""
    places = [(-0.13, 0.03), (-0.02, 0.01), (0.12, -0.05)]
    canny, ours, error = canny_errors(places, distortion, noise=2.0)
    assert np.all(canny.used), canny.reason
    assert abs(float(error.mean())) < 0.05  # signed: half a pixel somewhere would show
    assert float(np.sqrt(np.mean(error**2))) < 0.3
    for name in ("row", "leg", "edge"):
        np.testing.assert_array_equal(getattr(canny, name), getattr(ours, name))
    assert canny.part == ours.part


def test_a_straight_column_of_pixels_is_known_no_better_than_its_rounding() -> None:
    """An upright edge falls on one column: its scatter about the line is zero."""
    canny, _, _ = canny_errors([(0.0, 0.0)], noise=0.0)
    used = canny.used
    variance = canny.covariance[used][:, [0, 1], [0, 1]].min()
    n = np.linalg.norm(np.diff(canny.ends[used], axis=1)[:, 0], axis=1).max()
    # an end of a line by n points has 4 / n of their variance, which rounding keeps at 1 / (12 n)
    assert variance == pytest.approx(4.0 / 12.0 / n**2, rel=0.05)


def test_noise_that_shows_in_repeats_is_less_than_the_error_they_share() -> None:
    rng = np.random.default_rng(2)
    repeats = [
        canny_errors(BARS, None, lambda i: i + 2.0 * rng.standard_normal(i.shape), noise=0.0,
                     light=Light())[2]
        for _ in range(4)
    ]  # fmt: skip
    spread = float(np.std(np.array(repeats), axis=0).mean())
    assert spread < 0.1
    assert float(np.abs(np.mean(repeats, axis=0)).mean()) > 2.0 * spread


def test_an_outline_that_fades_away_is_rejected_with_a_reason() -> None:
    def fade(image: Array) -> Array:
        noise = np.random.default_rng(0).standard_normal(image.shape)
        return np.where(np.arange(image.shape[1]) < 180, 40.0 + noise, image)

    canny, _, _ = canny_errors(BARS, None, fade)
    np.testing.assert_array_equal(canny.used, [False, False, True, True])
    assert all(canny.reason[:2])


# The command


@pytest.fixture(scope="module")
def rendered(tmp_path_factory: pytest.TempPathFactory) -> RepeatedImages:
    """A hexapod in two poses, three images each; the last one shows nothing."""
    made = repeated_images(tmp_path_factory.mktemp("noise") / "hexapod")
    name = "images/p1_2.png"
    made.pictures[name] = np.full_like(made.pictures[name], 90.0)
    made.write()
    return made


@pytest.fixture(scope="module")
def found(rendered: RepeatedImages) -> DatasetNoise:
    return measure_noise(rendered.path)


@pytest.fixture
def spoiled(rendered: RepeatedImages, tmp_path: Path) -> RepeatedImages:
    """The same, to be changed and written."""
    entry = json.loads(json.dumps(rendered.entry))
    rows = [dict(row) for row in rendered.rows]
    return RepeatedImages(tmp_path / "set", rendered.machine, entry, rows, dict(rendered.pictures))


def test_json_is_one_document_whatever_the_order_and_the_folder_stays_as_it_was(
    spoiled: RepeatedImages,
    found: DatasetNoise,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    spoiled.rows.reverse()
    before = sorted(spoiled.write().rglob("*"))
    assert run(monkeypatch, "noise", spoiled.path, "--json") == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out) == found.document()
    assert sorted(spoiled.path.rglob("*")) == before
    for stage in ("Recognising legs", "Measuring outlines", "Canny and least squares"):
        assert stage in printed.err


def test_every_leg_has_standard_deviations_by_both_methods(found: DatasetNoise) -> None:
    """A detection that is missed leaves fewer repeats; the largest is the upper bound, named."""
    document = found.document()
    assert (document["images"], document["orientations"]) == (6, 2)
    assert document["repeats"] == {"least": 3, "most": 3}
    assert set(document["methods"]) == {"detector", "canny"}
    for method in document["methods"].values():
        assert [leg["leg"] for leg in method["legs"]] == [f"leg{j}" for j in range(1, 7)]
        for leg in method["legs"]:
            for name in ("outline", "psi", "theta", "angle", "across", "tilt", "depth"):
                spread = leg[name]
                assert 0.0 < spread["sd"] <= spread["largest"] * (1.0 + 1e-12)
                assert spread["ratio_low"] < spread["ratio"] < spread["ratio_high"]
                assert spread["ratio"] == pytest.approx(spread["sd"] / spread["claimed"])
            assert leg["outline"]["sd"] < 0.3
            assert leg["images"] == 6
            assert leg["outlines_found"] <= leg["outlines"] - 2
            axes = {o["pose"]: o["axes"] for o in leg["orientations"]}
            assert axes["p1"] <= 2
            assert leg["axes"] == sum(axes.values())
            assert leg["psi"]["dof"] <= sum(max(n - 1, 0) for n in axes.values()) + 1e-9
        # Far worse towards the camera than in the image.
        assert method["all"]["tilt"]["sd"] > 10.0 * method["all"]["angle"]["sd"]
        for name in (*QUANTITIES, "outline"):
            bound, at = method["upper_bound"][name], method["upper_bound_at"][name]
            assert bound == max(leg[name]["largest"] for leg in method["legs"] if leg[name])
            (leg,) = [leg for leg in method["legs"] if leg["leg"] == at["leg"]]
            assert leg[name]["largest"] == bound > method["all"][name]["median"]
            if name != "outline":
                values = {(o["view"], o["pose"]): o[name] for o in leg["orientations"]}
                assert values[at["view"], at["pose"]] == bound


def test_differences_of_methods_are_counted_outwards(found: DatasetNoise) -> None:
    """Canny puts both edges of a shaded leg inwards: counted to one side they would cancel."""
    every, by_leg = found.difference(), [found.difference(name) for name in found.leg_names]
    assert every is not None
    mean, rms = every
    assert -rms < mean < -0.5 * rms
    assert all(one is not None and one[0] < 0.0 for one in by_leg)


def test_an_edge_that_jumps_between_images_is_named(
    rendered: RepeatedImages, found: DatasetNoise
) -> None:
    measurements = load_dataset(rendered.path).measurements
    assert not any("jumps" in note for note in noise_notes(measurements, found.methods))
    detector, canny = found.methods
    first, *others = canny.legs[2].orientations
    jumping = replace(first.lines[0], covariance=400.0 * first.lines[0].claimed)
    first = replace(first, lines=(jumping, *first.lines[1:]))
    leg = replace(canny.legs[2], orientations=(first, *others))
    canny = replace(canny, legs=(*canny.legs[:2], leg, *canny.legs[3:]))
    (note,) = [n for n in noise_notes(measurements, [detector, canny]) if "jumps" in n]
    assert note.startswith("Canny:")
    assert f"leg3 in c1/{measurements.pose_labels[first.pose]} ({jumping.sd:.3f} px)" in note


def shown(noise: DatasetNoise) -> str:
    console = Console(width=80, record=True, file=StringIO())
    console.print(noise_table(noise))
    return console.export_text()


def test_the_table_fits_80_columns_and_says_what_repeats_do_not_show(found: DatasetNoise) -> None:
    text = shown(found)
    assert max(len(line) for line in text.splitlines()) <= 80
    flowing = " ".join(text.split())
    for words in (
        "psi [deg]", "x [mm]", "upper bound", "Canny", "claims", "claimed", "2/12", "not the bias",
        "median", "Upper bounds by detector: leg", "95 % ranges hold for normal",
    ):  # fmt: skip
        assert words in flowing
    assert text.count("leg1  ") == 3  # on one line in every table


def test_rows_that_nothing_repeats_are_left_out_and_wrong_cameras_are_noted(
    spoiled: RepeatedImages,
) -> None:
    for row, label in zip(spoiled.rows[3:], ("", "alone", "p1"), strict=True):
        row["pose"] = label
    view = spoiled.entry["views"]["c1"]
    view["legs"] = ["leg1", "leg3", "leg4", "leg6"]
    view["T_base_camera"]["xyz"] = [value + 0.3 for value in view["T_base_camera"]["xyz"]]
    document = measure_noise(spoiled.write()).document()
    assert (document["images"], document["orientations"]) == (3, 1)
    legs = document["methods"]["canny"]["legs"]
    assert {o["pose"] for leg in legs for o in leg["orientations"]} == {"p0"}
    assert "leg2 is in none of the repeated images." in document["notes"]
    assert legs[1]["psi"] is None
    assert any(n.startswith("view c1: its T_base_camera is wrong") for n in document["notes"])


def test_a_leg_along_the_image_x_axis_is_said_to_have_no_M_LS(tmp_path: Path) -> None:
    """Of another class; its passive legs and others are measured as well."""
    made = repeated_images(tmp_path / "level", "3-rps", n_poses=1, level_leg=1)
    noise = measure_noise(made.write())
    assert [leg.name for leg in noise.methods[0].legs] == list(load_mechanism("3-rps").leg_names)
    for method in noise.document()["methods"].values():
        leg = method["legs"][1]
        assert leg["axes"] == 3
        assert (leg["without_M_LS"], leg["x"], leg["z"]) == (1, None, None)
        assert leg["psi"]["sd"] > 0.0
        assert method["legs"][0]["without_M_LS"] == 0
    note = "leg2: M_LS does not exist for detector in 1 of 1 orientations (c1/p0), where the leg is"
    assert any(text.startswith(note) for text in noise.notes)
    assert shown(noise).count("no M_LS") == 4


def _no_pose_column(made: RepeatedImages) -> None:
    for row in made.rows:
        del row["pose"]


def _no_repeats(made: RepeatedImages) -> None:
    made.rows = [made.rows[0], made.rows[3]]


def _damaged(made: RepeatedImages) -> None:
    path = made.write() / "images/p0_1.png"
    path.write_bytes(path.read_bytes()[:-2000])
    made.pictures.clear()


def _nothing_shown(made: RepeatedImages, kept: str = "none") -> None:
    for name, picture in made.pictures.items():
        if not name.endswith(kept):
            made.pictures[name] = np.full_like(picture, 90.0)


def _a_motor_less(made: RepeatedImages) -> None:
    """Give the dataset a changed model of its own."""
    motor = str(made.machine.legs[0].prismatic)
    made.path.mkdir(parents=True)
    entry = yaml.safe_load(made.machine.yaml_path.read_text())
    entry["name_mot"].remove(motor)
    entry["legcal"]["urdf"] = "model.urdf"
    (made.path / "model.urdf").write_bytes(made.machine.urdf_path.read_bytes())
    (made.path / "model.yaml").write_text(yaml.safe_dump(entry, sort_keys=False))
    made.entry["mechanism"] = "model.yaml"
    for row in made.rows:
        del row[motor]


@pytest.mark.parametrize(
    ("spoil", "kind", "named"),
    [
        (_no_pose_column, NotIdentifiable, ("column pose", "several images")),
        (_no_repeats, NotIdentifiable, ("two images of one pose",)),
        (_damaged, DatasetError, ("p0_1.png", "cut off")),
        (_nothing_shown, NotVisible, ("view c1", "camera could not be placed")),
        (lambda made: _nothing_shown(made, "_0.png"), NotVisible, ("two images of the same pose",)),
        (_a_motor_less, NotIdentifiable, ("mobility 6", "5 motors")),
    ],
)
def test_what_gives_no_noise_is_refused_in_one_sentence(
    spoiled: RepeatedImages,
    spoil: Callable[[RepeatedImages], None],
    kind: type[LegcalError],
    named: tuple[str, ...],
) -> None:
    spoil(spoiled)
    with pytest.raises(kind) as refused:
        measure_noise(spoiled.write())
    assert [word for word in named if word not in str(refused.value)] == []
    assert len(refused.value.problems) == 1


def test_repeats_are_images_of_one_pose_in_one_view(
    rendered: RepeatedImages, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    measurements = load_dataset(rendered.path).measurements
    every, table = np.ones(6, dtype=np.bool_), Path("measurements.csv")
    groups = find_repeats(measurements, every, table)
    assert [g.rows.tolist() for g in groups] == [[0, 1, 2], [3, 4, 5]]
    assert len(find_repeats(measurements, np.arange(6) < 4, table)) == 1
    with pytest.raises(DatasetError, match="found no image in 6 rows"):
        find_repeats(measurements, ~every, table)
    apart = replace(measurements, view=np.arange(6, dtype=np.intp))
    with pytest.raises(NotIdentifiable, match="no two images of one pose in any view"):
        find_repeats(apart, every, table)
    assert run(monkeypatch, "noise", tmp_path / "nowhere") == 2
