"""Calibrations of photographs by a renderer that is not legcal's, against their truth.

    OMP_NUM_THREADS=1 python benchmarks/independent.py FOLDER... [--as none rough half ...]
        [--only GROUP] [--worst 12] [--overlays FOLDER] [--lines FILE]

Datasets in the formats of the documentation; beside each FOLDER stands FOLDER-truth with
``models/`` and ``truth.json``: of every image the legs' true contours in the camera frame. Where
readings are angles, the first rod is measured as well (true length, 0.05 mm). Each is calibrated as
it lies there or otherwise:

    none       without the rough poses and the lists of legs of its views
    rough      with them
    half       none, with every second image
    jpeg60, jpeg85   none, with photographs saved again with that quality
    gamma      none, with the gamma of the camera left to be estimated
    radii      none, with the radii of the legs fixed
    shaken     none, with photographs by cameras that turn by 1 px from image to image (seed 1)
    meshes     none, with the boxes of the model drawn as meshes: extrusions with plate and motor
    clicks     none, with landmarks.csv: the true joints in one picture of each view, as far as they
               are inside, with 3 px of noise (seed 1); where these have the cameras is printed

A line a calibration:

    views      placed, of those there are
    legs       used in an image, of those half visible there [%]
    width      sightings of parts with both edges whose width is not the cylinder's [%]
    used       outlines; ends of these off the true contour [px]: median, 90 %, and the share
               that is more than 1 px off
    off        error of the platform at the session's poses, rms [mm]; and what is stated of it
    e'C^-1e    of the platform over its rank; 1 where what is stated is true
    seconds    of the calibration

With ``--worst`` the outlines that are farthest off follow; with ``--lines`` what is measured is
added to a file of JSON lines.
"""

import argparse
import json
import re
import shutil
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import cv2
import numpy as np
import trimesh
import yaml
from real_cameras import normalised_square
from scipy.spatial.transform import RigidTransform, Rotation

from legcal import LegcalError, calibrate, load_dataset, load_mechanism
from legcal.calibration.doubts import width_counts
from legcal.calibration.result import Calibration
from legcal.data.landmarks import LANDMARKS_NAME
from legcal.data.outlines import Outlines
from legcal.geometry.motions import components, pose_distance
from legcal.machine.equations import pose_sensitivity
from legcal.machine.parameters import geometries, vector_of

VARIANTS = (
    *("none", "rough", "half", "jpeg60", "jpeg85", "gamma", "radii"),
    *("shaken", "meshes", "clicks"),
)
CLICK_PX = 3.0  # noise of clicks
SHAKE_PX = 1.0  # of a camera that does not stand still
OF_RADIUS = 0.3  # part of a radius within which a part is the rod whose contours are known
VISIBLE = 0.5  # share of a leg above which it ought to be used
HEADER = (
    f"{'set':18}{'as':8}{'views':>6}{'legs':>6}{'width':>7}{'used':>9}{'median':>8}"
    f"{'90 %':>7}{'>1 px':>7}"
    f"{'off':>9}{'stated':>8}{'e`C^-1e':>9}{'trusted':>9}{'seconds':>9}"
)


@dataclass(frozen=True)
class Outcome:
    """What calibrating a dataset gave."""

    dataset: str
    variant: str
    seconds: float = 0.0
    refusal: str = ""
    trusted: bool = False
    n_views: int = 0
    n_placed: int = 0
    legs: float = 0.0  # share of the half visible ones that are used
    n_used: int = 0
    width: float = 0.0  # share of the parts with both edges that have another width
    median: float = 0.0  # [px]
    most: float = 0.0  # 90 % [px]
    wrong: float = 0.0  # share of more than 1 px
    off: float = 0.0  # [m]
    sigma: float = 0.0  # [m]
    square: float = 0.0  # e' C^-1 e / rank

    def line(self) -> str:
        """Return a line of the table."""
        start = f"{self.dataset:18}{self.variant:8}"
        if self.refusal:
            return f"{start}{self.seconds:8.1f} s refused: {self.refusal[:300]}"
        return (
            f"{start}{f'{self.n_placed}/{self.n_views}':>6}{100 * self.legs:6.0f}"
            f"{100 * self.width:7.0f}{self.n_used:9d}{self.median:8.3f}{self.most:7.2f}"
            f"{100 * self.wrong:7.1f}"
            f"{1e3 * self.off:9.3f}{1e3 * self.sigma:8.3f}{self.square:9.2f}"
            f"{'yes' if self.trusted else 'no':>9}{self.seconds:9.1f}"
        )


def varied(folder: Path, variant: str, copy: Path) -> None:
    """Write a dataset as a variant has it; photographs are copied."""
    shutil.copytree(folder, copy)
    for path in [copy, *copy.rglob("*")]:
        path.chmod(path.stat().st_mode | 0o200)
    for name in ("observations.csv", ".legcal-cache.json"):
        (copy / name).unlink(missing_ok=True)
    file = copy / "dataset.yaml"
    content = yaml.safe_load(file.read_text())
    if variant != "rough":
        for view in content["views"].values():
            view.pop("T_base_camera", None)
            view.pop("legs", None)
        file.write_text(yaml.safe_dump(content, sort_keys=False))
    if variant == "shaken":
        shake(copy)
    if variant == "meshes":
        draw_meshes(copy)
    if variant == "clicks":
        click_joints(copy, folder.with_name(folder.name + "-truth"))
    if variant == "half":
        table = copy / content["measurements"]
        head, *rows = table.read_text().splitlines()
        table.write_text("\n".join([head, *rows[::2]]) + "\n")
    if variant == "gamma":
        for file in copy.glob("camera_info*.yaml"):
            camera = yaml.safe_load(file.read_text())
            camera.pop("gamma", None)
            file.write_text(yaml.safe_dump(camera, sort_keys=False))
    if variant.startswith("jpeg"):
        quality = [cv2.IMWRITE_JPEG_QUALITY, int(variant[4:])]
        table = copy / content["measurements"]
        text = table.read_text()
        for file in sorted((copy / "images").iterdir()):
            again = file.with_suffix(".jpg")
            picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
            if picture is None:
                raise SystemExit(f"{file} could not be read")
            file.unlink()
            cv2.imwrite(str(again), picture, quality)
            text = text.replace(file.name, again.name)
        table.write_text(text)


def shake(folder: Path) -> None:
    """Turn the camera of each photograph about a random axis, by a pixel or so."""
    dataset, rng = load_dataset(folder, check_images=False), np.random.default_rng(1)
    for row in range(dataset.measurements.n_rows):
        file = dataset.image_path(row)
        camera = dataset.measurements.views[dataset.measurements.view[row]].camera
        picture = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if file is None or picture is None:
            raise SystemExit(f"{file} could not be read")
        turn = Rotation.from_rotvec(SHAKE_PX / camera.K[0, 0] * rng.normal(size=3))
        H = camera.K @ turn.as_matrix() @ np.linalg.inv(camera.K)
        size = picture.shape[1], picture.shape[0]
        flags = cv2.INTER_LANCZOS4
        turned = cv2.warpPerspective(picture, H, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
        cv2.imwrite(str(file), turned, [cv2.IMWRITE_JPEG_QUALITY, 98])


def draw_meshes(folder: Path) -> None:
    """Draw the boxes of a model as meshes, as CAD has extruded bodies."""
    (file,) = (folder / "urdf").glob("*.urdf")

    def as_mesh(found: re.Match[str]) -> str:
        x, y, z = (float(size) for size in found[1].split())
        groove = 0.1 * y
        sizes_at = (
            ((x - groove, y, z), (-0.5 * groove, 0.0, 0.0)),
            ((groove, 0.5 * (y - groove), z), (0.5 * (x - groove), 0.25 * (y + groove), 0.0)),
            ((groove, 0.5 * (y - groove), z), (0.5 * (x - groove), -0.25 * (y + groove), 0.0)),
            ((1.1 * x, 1.1 * y, 0.03 * z), (0.0, 0.0, 0.485 * z)),
        )
        parts = [trimesh.creation.box(size).apply_translation(at) for size, at in sizes_at]
        motor = trimesh.creation.cylinder(0.4 * y, 0.2 * z).apply_translation((x, 0.0, -0.4 * z))
        name = f"body{found.start()}.stl"
        body: Any = trimesh.util.concatenate([*parts, motor])
        body.export(file.with_name(name))
        return f'<mesh filename="{name}"/>'

    file.write_text(re.sub(r'<box size="([^"]*)"/>', as_mesh, file.read_text()))


def click_joints(folder: Path, truth: Path) -> None:
    """Write the landmarks of a dataset by its truth, and print how far off they are."""
    true = json.loads((truth / "truth.json").read_text())
    of_image = {Path(image["file"]).stem: image for image in true["images"]}
    dataset, rng = load_dataset(folder, check_images=False), np.random.default_rng(1)
    m, names = dataset.measurements, dataset.machine.leg_names
    lines = ["view,image,joint,u,v,sigma"]
    for v, view in enumerate(m.views):
        image = m.image[int(np.flatnonzero(m.view == v)[0])]
        for name, leg in zip(names, of_image[Path(image).stem]["legs"], strict=True):
            for end, key in (("base", "A_cam"), ("platform", "B_cam")):
                px = view.camera.project(np.array(leg[key])) + CLICK_PX * rng.normal(size=2)
                if np.all((px >= 0.0) & (px <= [view.camera.width - 1, view.camera.height - 1])):
                    lines.append(f"{view.name},{image},{name}.{end},{px[0]:.1f},{px[1]:.1f},")
    (folder / LANDMARKS_NAME).write_text("\n".join(lines) + "\n")
    of_clicks = load_dataset(folder, check_images=False).measurements.views
    for view, camera in zip(of_clicks, true["cameras"], strict=True):
        T = np.array(camera["T_cam_base"])
        T[:3, 3] *= 1e-3
        if view.T_base_camera is None:
            continue
        placed = dataset.machine.T_base_Rb.inv() * view.T_base_camera
        far, turned = pose_distance(placed, RigidTransform.from_matrix(T).inv())
        print(f"    {view.name}: clicks {1e3 * far:.1f} mm, {np.degrees(turned):.2f} deg off")


def outcome(
    folder: Path,
    variant: str,
    overlays: Path | None = None,
    worst: int = 0,
    only: Literal["zeros", "lengths", "all"] | None = None,
) -> Outcome:
    """Calibrate a variant of a dataset, and compare it with the truth."""
    truth = folder.with_name(folder.name + "-truth")
    with TemporaryDirectory() as scratch:
        copy = Path(scratch) / folder.name
        varied(folder, variant, copy)
        into = None if overlays is None else overlays / f"{folder.name}-{variant}"
        begin = time.perf_counter()
        lengths = json.loads((truth / "truth.json").read_text()).get("rod_lengths")
        needed = not load_dataset(copy, check_images=False).machine.readings_carry_length
        try:
            calibration = calibrate(
                copy,
                priors=[f"leg1.base:leg1.platform={lengths[0]:.3f}+-0.05mm"] if needed else (),
                output=into,
                overlays=overlays is not None,
                use_cache=False,
                only=only,
                fixed=("*.radius*",) if variant == "radii" else (),
            )
        except LegcalError as error:
            seconds = time.perf_counter() - begin
            return Outcome(folder.name, variant, seconds, refusal=" ".join(str(error).split()))
        seconds = time.perf_counter() - begin
        return judged(folder.name, variant, seconds, calibration, truth, worst)


def judged(
    name: str, variant: str, seconds: float, calibration: Calibration, folder: Path, worst: int
) -> Outcome:
    """Compare a calibration with the truth and with what it says of itself."""
    solution, machine = calibration.solution, calibration.dataset.machine
    truth = load_mechanism(next((folder / "models").glob("*.yaml")))
    truth = truth.with_leg_order(machine.leg_names)
    legs, parametrization = solution.legs, solution.kinematic.parametrization
    step = vector_of(parametrization, geometries(truth), legs)
    step = step - vector_of(parametrization, legs, legs)
    poses = components(solution.T_Rb_Re)
    by_pose = pose_sensitivity(legs, parametrization, machine.frame_legs, *poses)
    C = solution.kinematic.total_covariance
    away = by_pose[:, 3:] @ step
    spread = np.einsum("kia,ab,kib->k", by_pose[:, 3:], C, by_pose[:, 3:])
    off, sigma = (float(np.sqrt(np.mean(x))) for x in (np.sum(away**2, axis=1), spread))

    m, o = calibration.dataset.measurements, solution.outlines
    file = json.loads((folder / "truth.json").read_text())
    of_image = {Path(image["file"]).stem: image for image in file["images"]}
    errors, described, used = [], [], set[tuple[int, int]]()
    for i in np.flatnonzero(o.used).tolist():
        row, leg = int(o.row[i]), int(o.leg[i])
        radius = machine.legs[leg].radius_of_part.get(o.part[i]) if leg < machine.n_legs else None
        if radius is None or abs(radius - 1e-3 * file["leg_radius"]) > OF_RADIUS * radius:
            continue  # an arm, or a body that is thicker than the rod
        camera = m.views[m.view[row]].camera
        true = of_image[Path(m.image[row]).stem]["legs"][leg]
        h = np.array(true[f"h{o.edge[i]}"])
        error = float(np.abs(camera.line_offset(h[None], camera.undistort(o.ends[i]))).max())
        errors.append(error)
        used.add((row, leg))
        described.append(f"{m.image[row]} {machine.leg_names[leg]} {o.part[i]} edge {o.edge[i]}")
    for i in np.argsort(errors)[::-1][:worst].tolist():
        print(f"    {errors[i]:8.2f} px  {described[i]}")
    visible = [
        (row, leg)
        for row, image in enumerate(m.image)
        for leg, true in enumerate(of_image[Path(image).stem]["legs"])
        if true["visible_fraction"] >= VISIBLE
    ]
    return Outcome(
        name,
        variant,
        seconds,
        trusted=calibration.verdict.trustworthy,
        n_views=len(m.views),
        n_placed=len({int(m.view[row]) for row, _ in used}),
        legs=len(used.intersection(visible)) / max(len(visible), 1),
        n_used=len(errors),
        width=other_widths(o),
        median=float(np.median(errors)),
        most=float(np.percentile(errors, 90)),
        wrong=float(np.mean(np.array(errors) > 1.0)),
        off=off,
        sigma=sigma,
        square=normalised_square(by_pose, C, step, machine.B_platform),
    )


def other_widths(outlines: Outlines) -> float:
    """Return the share of the sightings of parts with both edges that have another width."""
    parts = set(zip(outlines.leg.tolist(), outlines.part, strict=True))
    wrong, right = np.sum([width_counts(outlines, *part) for part in parts], axis=0).tolist()
    return float(wrong / max(wrong + right, 1))


def main() -> None:
    """Calibrate all datasets in all variants, and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--as", dest="variants", nargs="+", default=["none"], choices=VARIANTS)
    parser.add_argument("--worst", type=int, default=0)
    parser.add_argument("--only", choices=["zeros", "lengths", "all"])
    parser.add_argument("--overlays", type=Path)
    parser.add_argument("--lines", type=Path)
    given = parser.parse_args()
    print(HEADER, flush=True)
    for folder in given.folders:
        for variant in given.variants:
            found = outcome(folder.resolve(), variant, given.overlays, given.worst, given.only)
            print(found.line(), flush=True)
            if given.lines is not None:
                with given.lines.open("a") as file:
                    file.write(json.dumps(asdict(found)) + "\n")


if __name__ == "__main__":
    main()
