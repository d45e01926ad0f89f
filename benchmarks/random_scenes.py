"""Random scenes: a shipped machine, its true version, a camera anywhere, light, clutter, occluders.

What the method is given (:class:`Given`) is apart from the truth (:class:`Truth`).
"""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.calibration.ordered_dataset import nominal_poses
from legcal.data.measurements import Measurements, View
from legcal.geometry.motions import look_at
from legcal.geometry.types import Array, BoolArray, Image
from legcal.machine.leg import Cylinder as Visible
from legcal.machine.leg import LegKind
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.simulation.observe import legs_in_image, shares
from legcal.simulation.rendering.appearance import Appearance, Light
from legcal.simulation.rendering.scene import prepare_view
from legcal.simulation.session import commanded_poses
from legcal.simulation.settings import ParameterErrors, Sampling, Spread
from legcal.simulation.solids import (
    Box,
    Material,
    PlacedSolid,
    PosedMachine,
    Solid,
    SolidCylinder,
    dressed,
    pose_machine,
)
from legcal.simulation.truth import write_true_model
from legcal.vision.camera import Camera
from legcal.vision.visibility import Seen

SHIPPED = sorted(path.stem for path in (Path(__file__).parents[1] / "models").glob("*.yaml"))
VISIBLE = 0.5  # of a leg's length in one piece, from which on it must be found
SIZES = ((640, 480),) * 7 + ((1024, 768),) * 3 + ((1600, 1200), (2448, 2048))
WIDTHS = (12.0, 60.0)  # of the legs [px], for every 640 px of the picture's width the upper one
TRIES = 60  # of cameras and occluders


@dataclass(frozen=True, eq=False)
class Given:
    """What the method is given.

    Attributes
    ----------
    images : tuple of array
        Photographs of one view.
    measurements : Measurements
        One row for each of them, in one view without T_base_camera.
    A_base, B_base : (n_images, n_legs, 3) array
        Joint centres by the nominal model at the readings [m].
    cylinders : tuple, for each leg a tuple of SolidCylinder
        What can be seen of the nominal legs.
    leg_names : tuple of str
    size : float
        Mean leg length [m].
    """

    images: tuple[Image, ...]
    measurements: Measurements
    A_base: Array
    B_base: Array
    cylinders: tuple[tuple[Visible, ...], ...]
    leg_names: tuple[str, ...]
    size: float

    @property
    def camera(self) -> Camera:
        """The camera of the view."""
        return self.measurements.views[0].camera


@dataclass(frozen=True, eq=False)
class Truth:
    """What only the judge knows.

    Attributes
    ----------
    T_base_camera : RigidTransform
    A_base, B_base : (n_images, n_legs, 3) array
        Joint centres [m].
    cylinders : tuple, for each leg a tuple of SolidCylinder
    shown : tuple of Seen, for each image
        What can be seen of the legs.
    width : (n_images, n_legs) array
        Width of the thickest cylinder of each leg, in the middle of the leg [px].
    """

    T_base_camera: RigidTransform
    A_base: Array
    B_base: Array
    cylinders: tuple[tuple[Visible, ...], ...]
    shown: tuple[Seen, ...]
    width: Array

    @property
    def visible(self) -> BoolArray:
        """Which legs must be found, (n_images, n_legs)."""
        return np.asarray(
            (_shares(self.shown, self.width.shape[1]) >= VISIBLE) & (self.width >= WIDTHS[0])
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """A scene, and in words and numbers what makes it hard."""

    seed: int
    machine: str
    given: Given
    truth: Truth
    settings: dict[str, float | int | str]


def draw(seed: int) -> Scene:
    """Return the scene of a seed."""
    rng = np.random.default_rng([seed, 20240611])
    name = SHIPPED[seed % len(SHIPPED)]
    nominal = load_mechanism(name)
    coarse = bool(rng.random() < 0.25)
    with TemporaryDirectory() as folder:
        truth = write_true_model(nominal, _errors(coarse), rng, Path(folder))
    n = int(rng.choice([1, 2, 3, 4, 6, 8]))
    sampling = Sampling.EXTREME if rng.random() < 0.3 else Sampling.WORKSPACE
    poses = commanded_poses(truth, nominal, n, rng, sampling)
    shown = replace(truth, urdf=replace(truth.urdf, path=nominal.urdf.path))
    machines = pose_machine(truth, dressed(shown), poses)
    appearance = _appearance(rng)
    camera, T, shown_legs = _viewpoint(truth, machines, appearance.gamma, rng)
    occluded = rng.random() < 0.4
    occluders: tuple[PlacedSolid, ...] = ()
    if occluded:
        occluders, shown_legs = _occluders(truth, machines, camera, T, shown_legs, rng)
    scene = prepare_view(machines[0].solids, camera, T, appearance, rng)
    images = tuple(scene.render((*machine.solids, *occluders), rng) for machine in machines)
    measurements = _measurements(nominal, camera, poses.readings, rng)
    A, B = _nominal_joints(nominal, measurements)
    A_true, B_true = (np.array([getattr(m, x) for m in machines]) for x in ("A", "B"))
    cylinders = tuple(leg.cylinders for leg in truth.legs)
    width = _widths(camera, T, A_true, B_true, cylinders)
    settings: dict[str, float | int | str] = {
        "images": n, "errors": "10 mm" if coarse else "2 mm",
        "size": f"{camera.width}x{camera.height}",
        "lens": round(float(camera.distortion[0]), 2),
        "focal": round(float(camera.K[0, 0]) / camera.width, 2),
        "width": round(float(np.median(width)), 1), "clutter": appearance.clutter,
        "occluders": len(occluders), "blur": round(appearance.blur, 2), "bits": appearance.bits,
        "gamma": appearance.gamma, "light": len(appearance.lights),
        "background": round(appearance.background, 2),
    }  # fmt: skip
    return Scene(
        seed,
        name,
        Given(
            images,
            measurements,
            A,
            B,
            tuple(leg.cylinders for leg in nominal.legs),
            nominal.leg_names,
            nominal.size,
        ),
        Truth(T, A_true, B_true, cylinders, shown_legs, width),
        settings,
    )


def _errors(coarse: bool) -> ParameterErrors:
    """Return the errors of a true machine: 2 mm and 0.1 deg, or 10 mm and 3 deg."""
    length = Spread(10e-3 if coarse else 2e-3)
    angle = Spread(float(np.deg2rad(3.0 if coarse else 0.1)))
    return ParameterErrors(
        base_joints=length,
        platform_joints=length,
        offsets=length,
        lengths=length,
        axes=angle,
        twists=angle,
    )


def _appearance(rng: np.random.Generator) -> Appearance:
    """Return how the photographs look."""
    lights = tuple(
        Light(
            direction=(float(rng.normal()), float(rng.normal()), float(0.3 + abs(rng.normal()))),
            with_camera=bool(rng.random() < 0.4),
            strength=float(rng.uniform(0.2, 1.0)),
            shadows=bool(rng.random() < 0.7),
        )
        for _ in range(int(rng.integers(1, 4)))
    )
    return Appearance(
        lights=lights,
        ambient=float(rng.uniform(0.05, 0.3)),
        background=float(np.exp(rng.uniform(np.log(0.01), np.log(0.5)))),
        background_contrast=float(rng.uniform(0.0, 0.8)),
        texture=float(rng.uniform(0.0, 1.5)),
        clutter=int(rng.integers(0, 13)),
        cables=int(rng.choice([0, 0, 0, 1, 2])),
        table=bool(rng.random() < 0.6),
        exposure=float(rng.uniform(0.6, 1.6)),
        blur=float(rng.uniform(0.3, 1.3)),
        gamma=float(rng.choice([1.0, 2.2])),
        electrons=float(np.exp(rng.uniform(np.log(2000.0), np.log(20000.0)))),
        bits=16 if rng.random() < 0.3 else 8,
        colour=bool(rng.random() < 0.2),
        samples=13,
    )


def _lens(rng: np.random.Generator, gamma: float) -> Camera:
    """Return a camera with a wide or a long lens."""
    width, height = SIZES[int(rng.integers(len(SIZES)))]
    f = width * float(np.exp(rng.uniform(np.log(0.6), np.log(2.5))))
    K = np.array(
        [
            [f, 0.0, width * rng.uniform(0.47, 0.53)],
            [0.0, f, height * rng.uniform(0.47, 0.53)],
            [0.0, 0.0, 1.0],
        ]
    )
    strength = min(1.0, width / f)
    bent = np.array([rng.uniform(-0.3, 0.05), 0.06, 5e-4, -5e-4, 0.0]) * strength
    return Camera(K, width, height, bent, gamma=gamma)


def _viewpoint(
    truth: Machine, machines: tuple[PosedMachine, ...], gamma: float, rng: np.random.Generator
) -> tuple[Camera, RigidTransform, tuple[Seen, ...]]:
    """Return a camera, a place from which it sees enough legs, and how much of each leg."""
    joints = np.concatenate([np.concatenate([m.A, m.B]) for m in machines])
    centre, size = joints.mean(axis=0), float(np.linalg.norm(np.ptp(joints, axis=0)))
    radius = float(np.median([max(c.radius for c in leg.cylinders) for leg in truth.legs]))
    least = 2.0 if truth.n_legs <= 4 else 3.0
    for _ in range(50 * TRIES):
        camera = _lens(rng, gamma)
        f, widest = float(camera.K[0, 0]), WIDTHS[1] * camera.width / 640.0
        away = rng.normal(size=3)
        away /= np.linalg.norm(away)
        fill = rng.uniform(0.65, 1.35)
        distance = size * f / (fill * camera.height)
        width = 2.0 * radius * f / distance
        if not WIDTHS[0] <= width <= widest or distance < 0.75 * size:
            continue
        target = centre + 0.12 * size * rng.normal(size=3) * rng.choice([0.0, 1.0])
        T = look_at(target + distance * away, target, float(rng.uniform(0.0, 2.0 * np.pi)),
                    up=np.roll([0.0, 0.0, 1.0], int(rng.integers(3))))  # fmt: skip
        if any(m.encloses(T.translation) for m in machines):
            continue
        shown = _shown(truth, machines, camera, T)
        if (_shares(shown, truth.n_legs) >= VISIBLE).sum(axis=1).mean() >= least:
            return camera, T, shown
    raise RuntimeError("no place for a camera was found")


def _shown(
    truth: Machine, machines: tuple[PosedMachine, ...], camera: Camera, T: RigidTransform
) -> tuple[Seen, ...]:
    """Return what can be seen of the legs in every image."""
    return tuple(legs_in_image(truth.legs, m, camera, T, least=0.0) for m in machines)


def _shares(shown: tuple[Seen, ...], n_legs: int) -> Array:
    """Return what can be seen of every leg in every image, as part of its length."""
    return np.array([shares(image, n_legs)[0] for image in shown])


def _occluders(
    truth: Machine,
    machines: tuple[PosedMachine, ...],
    camera: Camera,
    T: RigidTransform,
    free: tuple[Seen, ...],
    rng: np.random.Generator,
) -> tuple[tuple[PlacedSolid, ...], tuple[Seen, ...]]:
    """Return boxes and rods in front that hide up to half of the legs, and what is left to see."""
    seen = int((_shares(free, truth.n_legs) >= VISIBLE).sum())
    for _ in range(TRIES):
        solids = tuple(
            _occluder(machines[0], camera, T, rng) for _ in range(int(rng.integers(1, 4)))
        )
        shown = _shown(truth, tuple(_beside(m, solids) for m in machines), camera, T)
        left = int((_shares(shown, truth.n_legs) >= VISIBLE).sum())
        if 0.5 * seen <= left < seen and left >= 1.5 * len(machines):
            return solids, shown
    return (), free


def _occluder(
    machine: PosedMachine,
    camera: Camera,
    T: RigidTransform,
    rng: np.random.Generator,
) -> PlacedSolid:
    """Return a box or a rod between the camera and a point of a leg."""
    j = int(rng.integers(len(machine.A)))
    point = machine.A[j] + rng.uniform(0.1, 0.9) * (machine.B[j] - machine.A[j])
    nearest = float(T.inv().apply(machine.vertices)[:, 2].min())
    P = T.inv().apply(point)
    z = max(nearest, 0.15 * P[2]) * rng.uniform(0.5, 0.85)
    pixel = z / float(camera.K[0, 0])
    picture = camera.height * pixel
    shape: Box | SolidCylinder
    if rng.random() < 0.5:
        shape = SolidCylinder(picture * rng.uniform(0.02, 0.06), picture * rng.uniform(0.5, 2.0))
        flat = Rotation.from_euler("xz", [0.5 * np.pi, rng.uniform(0.0, np.pi)])
        turn = T.rotation * Rotation.from_euler("z", rng.uniform(0.0, np.pi)) * flat
    else:
        a, b = (picture * rng.uniform(0.1, 0.5, 2)).tolist()
        shape = Box((a, b, 0.05 * picture))
        turn = T.rotation * Rotation.from_euler("zx", rng.uniform(-0.4, 0.4, 2) * [7.0, 1.0])
    material = Material(
        albedo=float(rng.uniform(0.05, 0.7)),
        specular=float(rng.choice([0.05, 0.3])),
        limb=float(rng.uniform(0.1, 0.4)),
        texture=float(rng.uniform(0.0, 0.2)),
    )
    where = RigidTransform.from_components(T.apply(P * z / P[2]), turn)
    return PlacedSolid(Solid(None, shape, where, material), where)


def _beside(machine: PosedMachine, solids: tuple[PlacedSolid, ...]) -> PosedMachine:
    """Return a machine together with what stands in front of it."""
    vertices, faces, n = [machine.vertices], [machine.faces], len(machine.vertices)
    for placed in solids:
        shape = placed.solid.shape
        if isinstance(shape, SolidCylinder):
            mesh = trimesh.creation.cylinder(shape.radius, shape.length)
        else:
            assert isinstance(shape, Box)
            mesh = trimesh.creation.box(shape.size)
        vertices.append(placed.T_base_solid.apply(mesh.vertices))
        faces.append(mesh.faces + n)
        n += len(mesh.vertices)
    return replace(
        machine,
        solids=(*machine.solids, *solids),
        vertices=np.concatenate(vertices),
        faces=np.concatenate(faces),
    )


def _measurements(
    nominal: Machine, camera: Camera, readings: Array, rng: np.random.Generator
) -> Measurements:
    """Return the rows of the images, as a dataset without hints has them."""
    q = readings + 2e-6 * rng.normal(size=readings.shape)
    for j, leg in enumerate(nominal.legs):
        if leg.kind is LegKind.CONSTANT:
            q[:, j] = 0.0
        elif leg.kind is LegKind.PASSIVE:
            q[:, j] = np.nan
    n = len(q)
    rows = np.arange(n, dtype=np.intp)
    names = tuple(f"{row + 1}.png" for row in range(n))
    view, sigma = np.zeros(n, dtype=np.intp), np.full(q.shape[1], 2e-6)
    return Measurements((View("c1", camera),), names, view, rows, q, sigma, names)


def _nominal_joints(nominal: Machine, measurements: Measurements) -> tuple[Array, Array]:
    """Return A and B of every image by the nominal model, (n_images, n_legs, 3) [m]."""
    back = nominal.T_platform_Re.inv()
    reached = nominal_poses(nominal, measurements)[0]
    platforms = [nominal.T_base_Rb * T * back for T in reached]
    B = np.array([T.apply(nominal.B_platform) for T in platforms])
    return np.broadcast_to(nominal.A_base, B.shape).copy(), B


def _widths(
    camera: Camera,
    T: RigidTransform,
    A: Array,
    B: Array,
    cylinders: tuple[tuple[Visible, ...], ...],
) -> Array:
    """Return the width of the thickest cylinder of each leg in each image [px]."""
    radius = np.array([max((c.radius for c in of_leg), default=0.0) for of_leg in cylinders])
    middle = T.inv().apply((0.5 * (A + B)).reshape(-1, 3)).reshape(A.shape)
    return np.asarray(2.0 * radius * camera.K[0, 0] / np.maximum(middle[..., 2], 1e-3))
