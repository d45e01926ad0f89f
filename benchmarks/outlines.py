"""Outlines measured in rendered pictures of single cylinders, against their exact places.

    OMP_NUM_THREADS=1 python benchmarks/outlines.py [--scenes 240] [--seed 0]

Every scene is a cylinder in any direction, lit by one lamp from somewhere and by light from
everywhere, before a plain or sloped background; material, light, background, lens, sensor and
width are drawn anew. Beside legcal's own measurement stand three ways to find an edge without a
model of it: the greatest gradient across the outline (a parabola through three pixels) and Canny's
points, both with a straight line by least squares, and OpenCV's line segment detector. All of
them are told where the outline is to half a pixel. A scene is photographed a few times: "bias" is
the mean of the errors of one outline in its middle, positive towards the inside, "scatter" their
standard deviation, and "pull" the root mean square of errors over the standard deviations claimed,
at both ends.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.detection.band import Band, band_of_leg
from legcal.detection.measure import Edge, measure_edges
from legcal.detection.picture import Grey, to_grey
from legcal.geometry.types import Array, Image
from legcal.repeatability.canny import edge_points
from legcal.simulation.rendering.appearance import Appearance, Light
from legcal.simulation.rendering.paint import Canvas
from legcal.simulation.rendering.scene import prepare_scene
from legcal.simulation.rendering.sensor import develop
from legcal.simulation.rendering.solid_in_view import in_view
from legcal.simulation.shapes import Cylinder
from legcal.simulation.solids import Material, PlacedSolid, Solid
from legcal.vision.camera import Camera
from legcal.vision.cylinder import EPSILON, outlines_of_axis

PHOTOGRAPHS = 3  # of every scene
FINE = 3  # times as many pixels are rendered in every row, so that the lens blurs before they count
START = 0.4  # how far the start is off at each end [px]
REACH = 2.5  # from the start, of a point that belongs to an outline [px]
DEEP = 2.5  # from the outline, where the contrast is read [px] and blurs
WIDTHS = (12.0, 25.0, 60.0, 200.0)
BLURS = (0.35, 0.6, 1.0, 1.8)  # at most a twelfth of the width
GAMMAS = (1.0, 2.2, -2.2)  # negative: not told
ELECTRONS = (40_000.0, 8_000.0, 1_500.0)
LIGHTS = ("front", "side", "rim")
BACKGROUNDS = ("dark", "bright", "like the leg")
METHODS = ("legcal", "gradient", "Canny", "LSD")


@dataclass(frozen=True, eq=False)
class Looks:
    """What is drawn for a scene.

    Attributes
    ----------
    width : float
        Of the cylinder in the middle of the picture [px].
    blur : float
        Of the lens [px]; that of the pixels comes on top.
    gamma : float
        Of the camera; negative if legcal is not told.
    electrons : float
        Of a pixel at full scale.
    bits : int
        8 or 16.
    light, background : str
        Where the lamp stands, and how bright it is behind.
    """

    width: float
    blur: float
    gamma: float
    electrons: float
    bits: int
    light: str
    background: str


@dataclass(frozen=True, eq=False)
class Photographed:
    """A scene, its photographs and the truth.

    Attributes
    ----------
    looks : Looks
        How it looks.
    images : list of array
        Photographs that differ by their noise.
    camera : Camera
        The camera.
    band : Band
        The frame along the cylinder.
    v : (2, 2) array
        True offsets of edge 1 and 2 at both ends of the band [px].
    contrast : (2,) array
        From the background to the leg at both edges [grey levels].
    """

    looks: Looks
    images: list[Image]
    camera: Camera
    band: Band
    v: Array
    contrast: Array


def draw_looks(rng: np.random.Generator) -> Looks:
    """Draw how a scene looks."""
    width = float(rng.choice(WIDTHS))
    return Looks(
        width,
        float(rng.choice([blur for blur in BLURS if 12.0 * blur <= width])),
        float(rng.choice(GAMMAS)),
        float(rng.choice(ELECTRONS)),
        int(rng.choice([8, 16])),
        str(rng.choice(LIGHTS)),
        str(rng.choice(BACKGROUNDS)),
    )


def photograph(looks: Looks, rng: np.random.Generator) -> Photographed:
    """Render a scene and photograph it."""
    side = 240 if looks.width < 100.0 else 360
    focal = 1.6 * side
    camera = Camera(
        np.array([[focal, 0.0, 0.5 * side], [0.0, focal, 0.5 * side], [0.0, 0.0, 1.0]]),
        side,
        side,
        np.array([rng.uniform(-0.15, 0.1), 0.03, 0.0, 0.0, 0.0]),
        gamma=max(looks.gamma, 1.0),
    )
    radius = 0.01
    distance = 2.0 * radius * focal / looks.width
    angle, tilt = rng.uniform(0.0, np.pi), rng.uniform(-0.6, 0.6)
    u = np.array([np.cos(angle) * np.cos(tilt), np.sin(angle) * np.cos(tilt), np.sin(tilt)])
    across = np.array([-np.sin(angle), np.cos(angle), 0.0])
    middle = np.array([0.0, 0.0, distance]) + across * rng.uniform(-0.08, 0.08) * distance
    reach = 0.9 * distance
    A, B = middle - reach * u, middle + reach * u
    band = band_of_leg(camera, A, B, 0.0, 2.0 * reach)
    if band is None:
        raise ValueError("the camera misses the cylinder")
    h = outlines_of_axis(u[None], middle[None], radius)[0]
    v = band.offsets(h[:, None, :], np.array([0.0, band.length]))
    material = Material(
        albedo=rng.uniform(0.15, 0.8),
        specular=rng.choice([0.0, 0.1, 0.4]),
        shininess=rng.choice([8.0, 40.0, 120.0]),
        limb=rng.choice([0.0, 0.3, 0.7]),
    )
    spread = {"front": (0.0, 0.5), "side": (0.7, 1.3), "rim": (1.5, 2.1)}[looks.light]
    away, around = rng.uniform(*spread), rng.uniform(0.0, 2.0 * np.pi)
    lamp = Light(
        (np.sin(away) * np.cos(around), np.sin(away) * np.sin(around), np.cos(away)),
        with_camera=True,
        strength=1.0,
        shadows=False,
    )
    appearance = Appearance.clean(
        lights=(lamp,), ambient=rng.uniform(0.05, 0.4), limb=1.0, specular=1.0, background=0.0,
        electrons=looks.electrons, read_noise=12.0, bits=looks.bits,
        gamma=abs(looks.gamma),
    )  # fmt: skip
    towards = Rotation.align_vectors(u[None], np.array([[0.0, 0.0, 1.0]]))[0]
    pose = RigidTransform.from_components(middle, towards)
    solid = PlacedSolid(
        Solid("leg", None, Cylinder(radius, 2.0 * reach), RigidTransform.identity(), material), pose
    )
    dark, bright = (
        _radiance(solid, camera, replace(appearance, background=level, samples=21))
        for level in (0.0, 1.0)
    )
    free = bright - dark  # share of each pixel that shows the background
    behind = _background(looks.background, dark, free, rng)
    light = _through_lens(dark + free * behind, looks.blur)
    light *= np.float32(rng.uniform(0.5, 0.95) / np.quantile(light, 0.98))
    images = [develop(light.copy(), appearance, rng) for _ in range(PHOTOGRAPHS)]
    plain = replace(appearance, electrons=np.inf, bits=16)
    contrast = _contrasts(to_grey(develop(light.copy(), plain, rng)), camera, band, v, looks.blur)
    told = replace(camera, gamma=1.0) if looks.gamma < 0.0 else camera
    return Photographed(looks, images, told, band, v, contrast)


def _radiance(solid: PlacedSolid, camera: Camera, appearance: Appearance) -> Grey:
    """Return the light of a solid before an even background, in fine pixels."""
    rng = np.random.default_rng(0)
    K = camera.K * FINE
    K[:2, 2] += 0.5 * (FINE - 1)
    K[2, 2] = 1.0
    camera = replace(camera, K=K, width=FINE * camera.width, height=FINE * camera.height)
    scene = prepare_scene([solid], camera, RigidTransform.identity(), appearance, rng)
    canvas = Canvas(scene.canvas.z.copy(), scene.canvas.terms.sum(axis=0)[None])
    scene.painter.paint(canvas, in_view([solid], scene.T_camera_base))
    return np.asarray(canvas.terms[0, 0].reshape(camera.height, camera.width))


def _through_lens(fine: Grey, blur: float) -> Grey:
    """Return the light that pixels gather behind a lens that blurs."""
    blurred = cv2.GaussianBlur(fine, (0, 0), FINE * blur)
    height, width = fine.shape
    gathered = blurred.reshape(height // FINE, FINE, width // FINE, FINE).mean(axis=(1, 3))
    return np.asarray(gathered, dtype=np.float32)


def _background(kind: str, dark: Grey, free: Grey, rng: np.random.Generator) -> Grey:
    """Return the light of a background that slopes a little."""
    leg = float(np.quantile(dark[free == 0.0], 0.9))
    level = {
        "dark": rng.uniform(0.01, 0.25) * leg,
        "bright": rng.uniform(1.3, 2.5) * leg,
        "like the leg": rng.uniform(0.3, 1.0) * leg,
    }[kind]
    height, width = dark.shape
    slope = rng.choice([0.0, 0.4]) * rng.uniform(-1.0, 1.0, 2)
    y, x = np.mgrid[-1.0 : 1.0 : height * 1j, -1.0 : 1.0 : width * 1j]
    return np.asarray(level * (1.0 + slope[0] * x + slope[1] * y), dtype=np.float32)


def _contrasts(grey: Grey, camera: Camera, band: Band, v: Array, blur: float) -> Array:
    """Return how much brighter the leg is than its background, along both edges."""
    t = np.linspace(0.1, 0.9, 50)
    deep = DEEP * (1.0 + blur)
    contrasts = []
    for ends, epsilon in zip(v, EPSILON, strict=True):
        at = ends[0] + (ends[1] - ends[0]) * t
        inside, outside = (
            _interpolated(grey, camera, band.points(t * band.length, at + epsilon * d)).mean()
            for d in (min(deep, 0.3 * abs(v[1, 0] - v[0, 0])), -deep)
        )
        contrasts.append(float(inside - outside))
    return np.array(contrasts)


def _interpolated(grey: Grey, camera: Camera, xy: Array) -> Grey:
    """Return grey levels at points of the sensor plane."""
    pixels = camera.distort(xy).astype(np.float32)
    mapped = cv2.remap(grey, pixels[..., 0], pixels[..., 1], cv2.INTER_CUBIC)
    return np.asarray(mapped, dtype=np.float32)


Ends = list[tuple[Array, Array] | None]
"""Of both edges: offsets at both ends of the band (2,) [px], and their standard deviations."""


def by_legcal(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Measure both edges as legcal does; errors at both ends of the used piece."""
    half_width = float(0.5 * np.mean(scene.v[1] - scene.v[0]))
    hidden = np.zeros(8, dtype=np.bool_)
    edges = [
        Edge(scene.band, v, float(epsilon), half_width, hidden)
        for v, epsilon in zip(start, EPSILON, strict=True)
    ]
    measured, _ = measure_edges(grey, scene.camera, edges)
    ends: Ends = []
    for edge, true in zip(measured, scene.v, strict=True):
        if edge is None:
            ends.append(None)
            continue
        place = np.array([edge.line.first, edge.line.last])
        error = (edge.v - true)[0] + np.diff(edge.v - true)[0] * place
        ends.append((error, np.sqrt(np.diag(edge.covariance))))
    return ends


def by_gradient(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Find the steepest place of every profile, and a line through these."""
    t = np.arange(2.0, scene.band.length - 2.0)
    d = np.arange(-4.0, 5.0)
    ends: Ends = []
    for v, true in zip(start, scene.v, strict=True):
        at = v[0] + (v[1] - v[0]) * t / scene.band.length
        xy = scene.band.points(t[:, None], at[:, None] + d)
        smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=np.float32)
        profile = _interpolated(smooth, scene.camera, xy)
        steep = np.abs(np.gradient(profile, axis=1))
        best = np.clip(np.argmax(steep[:, 1:-1], axis=1) + 1, 1, len(d) - 2)
        left, top, right = (steep[np.arange(len(t)), best + i] for i in (-1, 0, 1))
        bend = np.minimum(left - 2.0 * top + right, -1e-6)
        place = d[best] + np.clip(0.5 * (left - right) / bend, -0.5, 0.5)
        ends.append(_line(t / scene.band.length, at + place, v, true))
    return ends


def by_canny(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Find a line through Canny's points near each edge."""
    t, v = scene.band.coordinates(scene.camera.undistort(edge_points(grey)))
    t = t / scene.band.length
    along = (t > 0.0) & (t < 1.0)
    t, v = t[along], v[along]
    return [_line(t, v, ends, true) for ends, true in zip(start, scene.v, strict=True)]


def by_segments(scene: Photographed, grey: Grey, start: Array) -> Ends:
    """Find a line through the segments of OpenCV's detector near each edge."""
    eight = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    found = cv2.createLineSegmentDetector().detect(eight)[0]
    if found is None:
        return [None, None]
    segments = found.reshape(-1, 2, 2).astype(np.float64)
    steps = np.linspace(0.0, 1.0, 50)[:, None]
    points = segments[:, None, 0] + (segments[:, None, 1] - segments[:, None, 0]) * steps
    t, v = scene.band.coordinates(scene.camera.undistort(points))
    t = t / scene.band.length
    ends: Ends = []
    for line, true in zip(start, scene.v, strict=True):
        off = np.abs(v - line[0] - (line[1] - line[0]) * t)
        near = np.all(off < REACH, axis=1)
        ends.append(_line(t[near].ravel(), v[near].ravel(), line, true))
    return ends


def _line(t: Array, v: Array, start: Array, true: Array) -> tuple[Array, Array] | None:
    """Return the errors at both ends of the line through points, refined twice."""
    ends = start
    for reach in (REACH, 1.5, 1.5):
        near = np.abs(v - ends[0] - (ends[1] - ends[0]) * t) < reach
        if np.count_nonzero(near) < 10 or np.ptp(t[near]) < 0.2:
            return None
        design = np.column_stack([1.0 - t[near], t[near]])
        ends = np.linalg.lstsq(design, v[near], rcond=None)[0]
    return ends - true, np.full(2, np.nan)


MEASURED: dict[str, Callable[[Photographed, Grey, Array], Ends]] = {
    "legcal": by_legcal,
    "gradient": by_gradient,
    "Canny": by_canny,
    "LSD": by_segments,
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors of one outline by one method, towards the inside.

    Attributes
    ----------
    looks : Looks
        Of the scene.
    edge : int
        0 or 1.
    contrast : float
        With sign [grey levels].
    errors : (n, 2) array
        At both ends of every photograph in which it was found [px].
    sigma : (n, 2) array
        Claimed standard deviations [px].
    """

    looks: Looks
    edge: int
    contrast: float
    errors: Array
    sigma: Array


def outcomes(scene: Photographed, method: str, rng: np.random.Generator) -> list[Outcome]:
    """Measure all photographs of a scene."""
    found: list[list[tuple[Array, Array]]] = [[], []]
    for image in scene.images:
        start = scene.v + START * rng.standard_normal((2, 2))
        ends = MEASURED[method](scene, to_grey(image), start)
        for edge, (line, epsilon) in enumerate(zip(ends, EPSILON, strict=True)):
            if line is not None:
                found[edge].append((epsilon * line[0], line[1]))
    return [
        Outcome(
            scene.looks,
            edge,
            float(scene.contrast[edge]),
            np.array([error for error, _ in lines]).reshape(-1, 2),
            np.array([sigma for _, sigma in lines]).reshape(-1, 2),
        )
        for edge, lines in enumerate(found)
    ]


def row(title: str, chosen: dict[str, list[Outcome]]) -> str:
    """Return a line of the table: legcal in full, of the others what an outline is off."""
    cells = [f"{title:26s}{len(chosen['legcal']):5d}"]
    for method, outlines in chosen.items():
        seen = [o for o in outlines if len(o.errors)]
        if not seen:
            continue
        bias = np.array([o.errors.mean() for o in seen])
        if method == "legcal":
            middles = [o.errors.mean(axis=1) for o in seen if len(o.errors) > 1]
            scatter = np.sqrt(np.mean([middle.var(ddof=1) for middle in middles]))
            pull = np.concatenate([(o.errors / o.sigma).ravel() for o in seen])
            cells.append(
                f"{len(outlines) - len(seen):5d}{bias.mean():+8.3f}{np.sqrt(np.mean(bias**2)):7.3f}"
                f"{np.quantile(np.abs(bias), 0.95):7.3f}{np.abs(bias).max():7.2f}{scatter:9.3f}"
                f"{np.sqrt(np.mean(pull**2)):6.2f}{1.4826 * np.median(np.abs(pull)):6.2f}  "
            )
        else:
            cells.append(f"{bias.mean():+9.2f}{np.sqrt(np.mean(bias**2)):6.2f}")
    return "".join(cells)


CLEAR = 20.0  # contrast above which outlines ought to be good [grey levels]


def rows() -> list[tuple[str, Callable[[Outcome], bool]]]:
    """Return the titles of the table's lines and what they choose."""

    def clear(o: Outcome) -> bool:
        return abs(o.contrast) > CLEAR

    def told(o: Outcome) -> bool:
        return clear(o) and o.looks.gamma > 0.0

    lines: list[tuple[str, Callable[[Outcome], bool]]] = [
        ("contrast above 20, told", told),
        ("contrast 10 to 20", lambda o: 10.0 < abs(o.contrast) <= CLEAR and o.looks.gamma > 0.0),
        ("contrast 4 to 10", lambda o: 4.0 < abs(o.contrast) <= 10.0 and o.looks.gamma > 0.0),
    ]
    for name, choice in (
        ("linear", 1.0),
        ("gamma 2.2, told", 2.2),
        ("gamma 2.2, not told", -2.2),
    ):
        lines.append((name, lambda o, c=choice: clear(o) and o.looks.gamma == c))  # type: ignore[misc]
    lines += [
        ("brighter than behind", lambda o: told(o) and o.contrast > 0.0),
        ("darker than behind", lambda o: told(o) and o.contrast < 0.0),
    ]
    for field, values in (
        ("width", WIDTHS),
        ("blur", BLURS),
        ("electrons", ELECTRONS),
        ("bits", (8, 16)),
        ("light", LIGHTS),
        ("background", BACKGROUNDS),
    ):
        for value in values:
            title = f"{field} {value:g}" if not isinstance(value, str) else f"{field}: {value}"
            lines.append(
                (title, lambda o, f=field, v=value: told(o) and getattr(o.looks, f) == v)  # type: ignore[misc]
            )
    return lines


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--scenes", type=int, default=240, help="cylinders; 240")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    found: dict[str, list[Outcome]] = {method: [] for method in METHODS}
    for seed in range(options.scenes):
        rng = np.random.default_rng([options.seed, seed])
        scene = photograph(draw_looks(rng), rng)
        for method in METHODS:
            found[method].extend(outcomes(scene, method, np.random.default_rng(seed)))
    print(f"{'':31s}legcal{'':46s}{'gradient':>12s}{'Canny':>15s}{'LSD':>15s}")
    print(
        f"{'outlines [px]':26s}{'n':>5s}{'lost':>5s}{'bias':>8s}{'rms':>7s}{'95 %':>7s}{'most':>7s}"
        f"{'scatter':>9s}{'pull':>6s}{'rob.':>6s}  " + f"{'bias':>9s}{'rms':>6s}" * 3
    )
    for title, chosen in rows():
        print(row(title, {m: [o for o in outlines if chosen(o)] for m, outlines in found.items()}))


if __name__ == "__main__":
    main()
