"""How fast photographs are rendered: images a second of one core, with everything on.

    OMP_NUM_THREADS=1 python benchmarks/photographs.py [--images 15] [--scale 1] [--blur PX]
        [MODEL ...]

1024 x 768 times the scale, each shipped mechanism with balls, posts and plates on a table among 15
pieces of clutter, two lamps, soft shadows, limb darkening, highlights, lens distortion, blur, gamma
and noise, a new pose for every image and one scene for all images of a view. Times are those of the
processor: "scene" once a view, "image" the median and "png" the mean of writing it; the last column
counts all three, 15 images a view. In the end the memory that the process had at most is printed.
"""

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.geometry.types import Array
from legcal.machine.configurations import random_configurations
from legcal.machine.loader import load_mechanism
from legcal.machine.model import Machine
from legcal.simulation.rendering.appearance import Appearance
from legcal.simulation.rendering.scene import prepare_view
from legcal.simulation.solids import PlacedSolid, dressed, link_poses, placed
from legcal.vision.camera import Camera

MODELS = Path(__file__).parents[1] / "models"
CAMERA = Camera(
    np.array([[1290.3, 0.0, 518.3], [0.0, 1290.3, 379.6], [0.0, 0.0, 1.0]]),
    1024,
    768,
    np.array([-0.12, 0.05, 0.0005, -0.0003, 0.0]),
)
PER_VIEW = 15


def looking_at(solids: tuple[PlacedSolid, ...]) -> RigidTransform:
    """Return T_base_camera of a camera beside the machine, which fills its picture."""
    points = np.array([p.T_base_solid.translation for p in solids])
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    away = np.array([0.8, 0.5, 0.35]) / np.linalg.norm([0.8, 0.5, 0.35])
    x = np.cross(-away, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x)
    turn = Rotation.from_matrix(np.column_stack([x, np.cross(-away, x), -away]))
    distance = 4.2 * np.linalg.norm(points - centre, axis=1).max()
    return RigidTransform.from_components(centre + distance * away, turn)


def seconds(action: Callable[[], object]) -> float:
    """Return the processor time of an action."""
    begin = time.process_time()
    action()
    return time.process_time() - begin


def scaled(camera: Camera, scale: float) -> Camera:
    """Return a camera with so many times the pixels in each row and column."""
    K = camera.K * [[scale], [scale], [1.0]]
    width, height = round(scale * camera.width), round(scale * camera.height)
    return replace(camera, K=K, width=width, height=height)


def measure(machine: Machine, n: int, camera: Camera, look: Appearance) -> str:
    """Return the times of a mechanism as a line of the table."""
    configurations: Array = random_configurations(machine, n, 1).configurations
    solids = dressed(machine)
    poses = [placed(solids, link_poses(machine, q)) for q in configurations]
    T = looking_at(poses[0])
    prepare_view(poses[0], camera, T, look, np.random.default_rng(0))  # loads and caches
    rng = np.random.default_rng(0)
    begin = time.process_time()
    scene = prepare_view(poses[0], camera, T, look, rng)
    preparing = time.process_time() - begin
    rendering, images = [], []
    for pose in poses:
        rendering.append(seconds(lambda pose=pose: images.append(scene.render(pose, rng))))  # type: ignore[misc]
    with TemporaryDirectory() as folder:
        png = Path(folder) / "image.png"
        writing = [seconds(lambda i=i: cv2.imwrite(str(png), i)) for i in images]  # type: ignore[misc]
    image, write = float(np.median(rendering)), float(np.mean(writing))
    rate = PER_VIEW / (preparing + PER_VIEW * (image + write))
    return f"{len(solids):6d}{1e3 * preparing:9.0f}{1e3 * image:9.0f}{1e3 * write:9.0f}{rate:9.2f}"


def main() -> None:
    """Print a line a model."""
    shipped = sorted(path.stem for path in MODELS.glob("*.yaml"))
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("models", nargs="*", metavar="MODEL", help="shipped models; all of them")
    parser.add_argument("--images", type=int, default=15, help="photographs of each; 15")
    parser.add_argument("--scale", type=float, default=1.0, help="of the size of pictures; 1")
    parser.add_argument("--blur", type=float, default=Appearance().blur, help="of the lens [px]")
    options = parser.parse_args()
    if unknown := set(options.models) - set(shipped):
        parser.error(f"found {', '.join(sorted(unknown))}, needed some of {', '.join(shipped)}")
    if options.images < 1:
        parser.error(f"found {options.images} images, needed at least one")
    print(f"{'[ms]':16}{'solids':>6}{'scene':>9}{'image':>9}{'png':>9}{'images/s':>9}")
    camera, look = scaled(CAMERA, options.scale), Appearance(blur=options.blur)
    for name in options.models or shipped:
        line = measure(load_mechanism(name), options.images, camera, look)
        print(f"{name:16}{line}", flush=True)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(f"{camera.width} x {camera.height} px: at most {most:.1f} GB")


if __name__ == "__main__":
    main()
