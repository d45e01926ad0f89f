"""Detection on rendered scenes whose outlines are known exactly, and on sample photographs."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from rendering import Bar, Light, render
from scipy.spatial.transform import RigidTransform

from legcal.data.measurements import Measurements, View
from legcal.data.outlines import Outlines
from legcal.geometry.types import Array, Image
from legcal.machine import Cylinder
from legcal.perception.detection import measure_outlines
from legcal.perception.placement import Placement, Search
from legcal.perception.recognition import recognise
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON, outlines_of_axis

ROOT = Path(__file__).resolve().parents[1]
IDENTITY = RigidTransform.identity()
F = 700.0


def camera(distortion: Array | None = None) -> Camera:
    K = np.array([[F, 0.0, 181.3], [0.0, 1.01 * F, 133.1], [0.0, 0.0, 1.0]])
    return Camera(K, 360, 270, np.zeros(0) if distortion is None else distortion)


def bar(x: float, lean: float, albedo: float, radius: float = 0.011, depth: float = 0.8) -> Bar:
    A, B = np.array([x - lean, 0.16, depth]), np.array([x + lean, -0.16, depth + 0.04])
    return Bar(A, B, radius, albedo)


def measurements(cam: Camera, n_legs: int) -> Measurements:
    one = np.zeros(1, dtype=np.intp)
    return Measurements((View("c1", cam),), ("a.png",), one, one, np.zeros((1, n_legs)), 1e-6)


def cylinder(b: Bar, radius: float | None = None) -> tuple[Cylinder, ...]:
    length = float(np.linalg.norm(b.B - b.A))
    return (Cylinder("rod", b.radius if radius is None else radius, "base", 0.0, length),)


def detect(
    cam: Camera, bars: list[Bar], image: Image, off: float = 2e-3, radius: float | None = None
) -> Outlines:
    """Detect bars whose predicted joints are ``off`` metres wrong in every coordinate."""
    return detect_with_blur(cam, bars, image, off, radius)[0]


def detect_with_blur(
    cam: Camera,
    bars: list[Bar],
    image: Image,
    off: float = 2e-3,
    radius: float | None = None,
    known: tuple[float, ...] = (),
) -> tuple[Outlines, float]:
    """Return the blur of the image as well; that of the view may be known [px]."""
    rng = np.random.default_rng(0)
    A = np.array([b.A for b in bars])[None] + off * rng.choice([-1.0, 1.0], (1, len(bars), 3))
    B = np.array([b.B for b in bars])[None] + off * rng.choice([-1.0, 1.0], (1, len(bars), 3))
    names = [f"leg{i + 1}" for i in range(len(bars))]
    wanted, one_view = np.ones((1, len(bars)), dtype=np.bool_), measurements(cam, len(bars))
    cylinders = [cylinder(b, radius) for b in bars]
    search = Search(lambda row: image, one_view, A, B, cylinders, wanted, names)
    found, blur = measure_outlines(search, Placement(A, B, (IDENTITY,), blur=known), [0])
    return found, float(blur[0])


def errors(cam: Camera, bars: list[Bar], found: Outlines) -> Array:
    """Return the errors at both ends of each used outline, positive to the inside (n, 2) [px]."""
    rows = np.flatnonzero(found.used)
    error = np.empty((len(rows), 2))
    for k, i in enumerate(rows):
        b = bars[found.leg[i]]
        u = (b.B - b.A) / np.linalg.norm(b.B - b.A)
        h = outlines_of_axis(u, b.A, b.radius)[found.edge[i] - 1]
        offset = cam.line_offset(h[None], cam.undistort(found.ends[i]))
        error[k] = EPSILON[found.edge[i] - 1] * offset
    return error


def backdrop(level: float) -> Array:
    """Return a background with a slope and soft texture."""
    texture = cv2.GaussianBlur(np.random.default_rng(7).standard_normal((270, 360)), (0, 0), 6.0)
    return np.asarray(level + 0.05 * np.arange(360.0) + 20.0 * texture)


SCENES = {
    "bright on dark": (backdrop(20.0), 170.0, Light(), 0.5),
    "dark on bright": (backdrop(200.0), 40.0, Light(), 0.8),
    "bright on one side, dark on the other": (
        backdrop(90.0),
        170.0,
        Light(direction=(0.95, 0.0, -0.3), ambient=0.1, diffuse=0.9),
        0.5,
    ),
    "a highlight along the leg": (backdrop(30.0), 110.0, Light(gloss=0.6), 0.4),
    "blurred": (backdrop(30.0), 140.0, Light(), 1.2),
}


@pytest.mark.parametrize("name", SCENES)
def test_outlines_are_found_where_they_are(name: str) -> None:
    background, albedo, light, blur = SCENES[name]
    cam = camera()
    bars = [bar(-0.09, 0.03, albedo), bar(0.08, -0.05, albedo)]
    image = render(cam, bars, background, light, blur=blur, noise=2.0, supersample=4)
    found = detect(cam, bars, np.rint(image).astype(np.uint8))
    assert np.all(found.used), found.reason
    error = errors(cam, bars, found)
    assert np.abs(error).max() < (0.2 if blur < 1.0 else 0.4)
    assert np.median(np.abs(error)) < (0.08 if blur < 1.0 else 0.15)
    assert abs(float(error.mean())) < (
        0.05 if blur < 1.0 else 0.15
    )  # signed: half a pixel somewhere would show
    sigma = np.sqrt([np.diag(c) for c in found.covariance])
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 2.0


@pytest.mark.parametrize(
    ("level", "blur"),
    [(252.0, 0.5), (270.0, 0.3), (270.0, 1.0), (300.0, 0.5), (300.0, 1.0), (400.0, 1.0)],
)
def test_a_saturated_background_moves_no_outline(level: float, blur: float) -> None:
    cam = camera()
    bars = [bar(-0.05, 0.02, 60.0), bar(0.06, 0.02, 60.0)]
    behind = np.full((270, 360), 120.0)
    behind[:, 181:] = level  # behind the second leg
    image = render(cam, bars, behind, blur=blur, noise=1.0, supersample=4)
    clipped = np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)
    found, seen = detect_with_blur(cam, bars, clipped, off=1e-3)
    assert np.all(found.used), found.reason
    error = errors(cam, bars, found)
    sigma = np.sqrt([np.diag(c) for c in found.covariance])
    assert np.abs(error).max() < 0.15
    assert np.sqrt(np.mean((error / sigma) ** 2)) < 1.5
    assert seen == pytest.approx(np.hypot(blur, 0.29), rel=0.15)  # with that of the pixels


def test_outlines_are_rejected_where_saturation_leaves_nothing_of_the_step() -> None:
    cam = camera()
    bars = [bar(-0.05, 0.02, 60.0), bar(0.06, 0.02, 60.0)]
    image = render(cam, bars, 1000.0, blur=0.5, noise=1.0, supersample=4)
    clipped = np.clip(np.rint(image), 0.0, 255.0).astype(np.uint8)
    found = detect(cam, bars, clipped, off=1e-3)
    assert not np.any(found.used), errors(cam, bars, found)
    assert any("the background is overexposed" in reason for reason in found.reason), found.reason


@pytest.mark.parametrize("known", [0.45, 0.6])
def test_outlines_near_a_fit_are_found_with_the_blur_of_other_images(known: float) -> None:
    background, albedo, light, blur = SCENES["bright on dark"]
    cam = camera()
    bars = [bar(-0.09, 0.03, albedo), bar(0.08, -0.05, albedo)]
    image = render(cam, bars, background, light, blur=blur, noise=2.0, supersample=4)
    found, seen = detect_with_blur(
        cam,
        bars,
        np.rint(image).astype(np.uint8),
        off=2e-4,  # as after a fit: some tenths of a pixel
        known=(known,),
    )
    assert np.all(found.used), found.reason
    error = errors(cam, bars, found)
    assert np.abs(error).max() < 0.2
    assert np.median(np.abs(error)) < 0.08
    assert seen == pytest.approx(np.hypot(blur, 0.29), rel=0.25)  # with that of the pixels


def test_an_edge_stands_alone_where_the_other_side_is_as_dark_as_the_background() -> None:
    cam = camera()
    light = Light(direction=(1.0, 0.0, -0.3), ambient=0.1, diffuse=0.9)
    bars = [bar(-0.09, 0.03, 170.0, 0.015), bar(0.08, -0.05, 170.0, 0.015)]
    image = render(cam, bars, 17.0, light, blur=0.6, noise=2.0, supersample=4)
    found = detect(cam, bars, np.rint(image).astype(np.uint8))
    np.testing.assert_array_equal(found.used, [True, False, True, False])
    assert np.abs(errors(cam, bars, found)).max() < 0.2
    assert all(found.reason[i] for i in (1, 3))


@pytest.mark.parametrize("kind", ["uint16", "colour"])
def test_outlines_are_straight_in_space_and_not_in_the_picture(kind: str) -> None:
    cam = camera(np.array([-0.3, 0.1, 0.001, -0.002, 0.0]))
    bars = [bar(-0.15, 0.02, 150.0), bar(0.15, -0.02, 150.0)]
    image = render(cam, bars, 30.0, blur=0.6, supersample=4)
    stored: Image = np.rint(257.0 * image).astype(np.uint16)
    if kind == "colour":
        stored = np.repeat(np.rint(image).astype(np.uint8)[..., None], 3, axis=2)
    found = detect(cam, bars, stored)
    assert np.all(found.used), found.reason
    assert np.abs(errors(cam, bars, found)).max() < 0.15


def test_a_leg_may_be_wide_or_narrow() -> None:
    cam = camera()
    for radius in (0.007, 0.035):
        bars = [bar(0.0, 0.03, 150.0, radius)]
        image = render(cam, bars, backdrop(30.0), blur=0.5, supersample=4)
        found = detect(cam, bars, image.astype(np.uint8), off=1e-3)
        assert np.all(found.used), found.reason
        assert np.abs(errors(cam, bars, found)).max() < 0.25


def test_edges_near_the_leg_are_not_taken_for_it() -> None:
    cam = camera()
    bars = [bar(0.0, 0.03, 150.0)]
    image = render(cam, bars, 40.0, blur=0.5, supersample=4)
    for offset, level in ((-45, 230.0), (-25, 10.0), (18, 90.0), (33, 220.0)):
        slope = round(2 * 0.03 * F / 0.82)
        start, end = (181 + offset - slope // 2, 269), (181 + offset + slope // 2, 0)
        cv2.line(image, start, end, level, 2, cv2.LINE_AA)
    found = detect(cam, bars, image.astype(np.uint8))
    assert np.any(found.used), found.reason
    error = errors(cam, bars, found)
    assert np.all(np.abs(error) < 1.0)


def test_legs_behind_others_end_where_they_are_hidden() -> None:
    cam = camera()
    front, behind = bar(0.0, 0.08, 60.0, depth=0.7), bar(0.0, -0.08, 170.0, depth=0.9)
    image = render(cam, [front, behind], 30.0, blur=0.5, supersample=4)
    found = detect(cam, [front, behind], image.astype(np.uint8))
    assert np.all(found.used), found.reason
    assert np.abs(errors(cam, [front, behind], found)).max() < 0.2
    gap = np.linalg.norm(np.diff(found.ends, axis=1)[:, 0], axis=1) - found.length
    assert np.all(gap > -1.0)
    assert np.all(gap[2:] > 20.0)  # the leg in front hides the middle


def test_outlines_say_how_well_they_were_seen() -> None:
    cam = camera()
    bars = [bar(-0.09, 0.03, 150.0), bar(0.08, 0.03, 90.0), bar(0.9, 0.0, 150.0)]
    flat = Light(ambient=1.0, diffuse=0.0)
    image = render(cam, bars[:2], 30.0, flat, blur=0.5, noise=2.0, supersample=4)
    found = detect(cam, bars, np.rint(image).astype(np.uint8))
    np.testing.assert_allclose(found.contrast[:4], [120.0, 120.0, 60.0, 60.0], rtol=0.05)
    seen = np.linalg.norm(found.ends[:4, 1] - found.ends[:4, 0], axis=1)
    assert np.all(np.abs(found.length[:4] - seen) < 20.0)
    assert np.all((found.residual[:4] > 0.0) & (found.residual[:4] < 0.1))
    assert np.mean(found.residual[2:4]) > 1.2 * np.mean(found.residual[:2])
    for values in (found.contrast, found.length, found.residual):
        assert np.all(np.isnan(values[4:]))


def test_a_leg_that_another_covers_is_left_out_by_its_name() -> None:
    cam = camera()
    front, behind = bar(0.0, 0.03, 60.0, 0.03, 0.6), bar(0.0, 0.04, 170.0, depth=0.9)
    image = render(cam, [front, behind], 30.0, blur=0.5, supersample=3)
    found = detect(cam, [front, behind], image.astype(np.uint8))
    assert found.reason[2:] == ("hidden by leg1", "hidden by leg1")
    assert np.all(np.isnan(found.h[2:]))


def test_what_is_not_there_is_rejected_with_the_reason() -> None:
    cam = camera()
    bars = [bar(0.0, 0.03, 150.0), bar(0.9, 0.0, 150.0)]
    image = render(cam, bars[:1], 40.0, blur=0.5, supersample=3).astype(np.uint8)
    found = detect(cam, bars, image)
    assert found.reason[2:] == ("outside the image",) * 2
    empty = detect(cam, bars[:1], np.full_like(image, 90))
    assert set(empty.reason) == {"no convincing pair of edges"}
    noise = np.random.default_rng(0).integers(80, 100, image.shape).astype(np.uint8)
    assert not np.any(detect(cam, bars[:1], noise).used)


def test_a_leg_of_another_radius_is_not_trusted() -> None:
    cam = camera()
    bars = [bar(0.0, 0.03, 150.0, radius=0.02)]
    image = render(cam, bars, 40.0, blur=0.5, supersample=3).astype(np.uint8)
    assert np.all(detect(cam, bars, image).used)
    found = detect(cam, bars, image, radius=0.016)
    assert not np.any(found.used)


def test_a_faint_leg_gets_a_wide_covariance_or_none() -> None:
    cam = camera()
    bars = [bar(0.0, 0.03, 60.0)]
    flat = Light(ambient=1.0, diffuse=0.0)
    clear = detect(cam, bars, render(cam, bars, 20.0, flat, supersample=3).astype(np.uint8))
    faint = detect(
        cam, bars, np.rint(render(cam, bars, 52.0, flat, supersample=3)).astype(np.uint8)
    )
    assert np.all(clear.used)
    assert np.any(faint.used), faint.reason
    for i in np.flatnonzero(faint.used):
        assert np.trace(faint.covariance[i]) > 2.0 * np.trace(clear.covariance[i])


def test_tube_and_rod_are_two_parts() -> None:
    cam = camera()
    whole = bar(0.0, 0.03, 150.0)
    middle = 0.5 * (whole.A + whole.B)
    tube, rod = Bar(whole.A, middle, 0.014, 150.0), Bar(middle, whole.B, 0.009, 150.0)
    image = render(cam, [tube, rod], 30.0, blur=0.5, supersample=4).astype(np.uint8)
    length = float(np.linalg.norm(whole.B - whole.A))
    parts = (
        Cylinder("tube", 0.014, "base", 0.0, 0.5 * length),
        Cylinder("rod", 0.009, "platform", -0.8 * length, 0.0),
    )
    A, B, wanted = whole.A[None, None], whole.B[None, None], np.ones((1, 1), dtype=np.bool_)
    search = Search(lambda row: image, measurements(cam, 1), A, B, [parts], wanted, ["leg1"])
    found, _ = measure_outlines(search, Placement(A, B, (IDENTITY,)), [0])
    assert found.part == ("rod", "rod", "tube", "tube")
    assert np.all(found.used), found.reason
    for i, one in ((slice(0, 2), rod), (slice(2, 4), tube)):
        u = (one.B - one.A) / np.linalg.norm(one.B - one.A)
        h = outlines_of_axis(u, one.A, one.radius)
        offset = cam.line_offset(h[:, None], cam.undistort(found.ends[i]))
        assert np.abs(offset).max() < 0.15


def test_the_sample_is_detected_from_its_nominal_model() -> None:
    """Nine of the photographs; the benchmark sample_outlines.py measures all of them."""
    from legcal.data.dataset import load_dataset
    from legcal.machine import forward_kinematics

    folder = ROOT / "examples" / "hexapod"
    dataset = load_dataset(folder)
    machine = dataset.machine
    rows = np.arange(0, 45, 5)
    whole = dataset.measurements
    chosen = Measurements(
        whole.views,
        tuple(whole.image[row] for row in rows),
        whole.view[rows],
        np.arange(len(rows)),
        whole.q[rows],
        whole.sigma_q,
    )

    def load(row: int) -> Image:
        image = cv2.imread(str(folder / chosen.image[row]), cv2.IMREAD_UNCHANGED)
        assert image is not None
        return np.asarray(image)

    A = np.repeat(machine.A_base[None], len(rows), axis=0)
    B = np.array([forward_kinematics(machine, q).apply(machine.B_platform) for q in chosen.q])
    cylinders = [leg.cylinders for leg in machine.legs]
    wanted = np.ones((3, 6), dtype=np.bool_)
    search = Search(load, chosen, A, B, cylinders, wanted, machine.leg_names)
    placed = recognise(search, np.arange(len(rows)), [None] * 3)
    found, _ = measure_outlines(search, placed, range(len(rows)))
    truth = json.loads((ROOT / "tests/data/hexapod-truth/truth.json").read_text())
    legs = {image["file"]: image["legs"] for image in truth["images"]}
    middle, visible = np.full(len(found), np.nan), np.zeros(len(found))
    for i in range(len(found)):
        leg = legs[chosen.image[found.row[i]]][found.leg[i]]
        visible[i] = leg["visible_fraction"]
        if found.used[i]:
            cam = chosen.views[chosen.view[found.row[i]]].camera
            h = np.array(leg[f"h{found.edge[i]}"])
            offset = cam.line_offset(h[None], cam.undistort(found.ends[i]))
            middle[i] = EPSILON[found.edge[i] - 1] * offset.mean()
    used = middle[found.used]
    assert np.mean(found.used[visible > 0.5]) >= 0.95
    assert np.abs(used).max() < 0.5
    assert np.mean(np.abs(used) < 0.1) > 0.9
    assert abs(float(np.median(used))) < 0.04
