"""Which zero is wrong? What ``legcal calibrate --only zeros`` says of five images by a phone.

    OMP_NUM_THREADS=1 python benchmarks/zeros.py [--seeds 1 50] [--level outlines | photographs]
        [--model servo-hexapod] [--images 5] [--keep FOLDER]

A session is one to three poses and a camera in the hand, whose focal length is known to 3 %, before
a machine whose parts err by its tolerances; the zeros of all servos err as well, and of odd seeds
one horn is a tooth off. A line a session, then how many of them are named rightly, and nse: the
mean of ((zero - truth) / sigma)^2 over all motors, 1 where sigmas are honest.
"""

import argparse
import csv
import shutil
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import yaml

from legcal import LegcalError, calibrate, load_mechanism
from legcal.geometry.types import Array
from legcal.machine.home import home_of_legs
from legcal.machine.leg import LegColumns
from legcal.machine.model import Machine
from legcal.machine.parameters import geometries, in_joint_frames, moved_legs
from legcal.machine.rods import reading_legs
from legcal.simulation.cameras import mild_lens
from legcal.simulation.dataset import simulate
from legcal.simulation.rendering.appearance import CAMERAS, Appearance
from legcal.simulation.session import draw_poses
from legcal.simulation.settings import Distribution, ParameterErrors, SimulationSettings, Spread
from legcal.simulation.truth import write_model_with
from legcal.vision.camera import intrinsic_names

TEETH = 25
JOINTS, AXES, LENGTHS = 0.3e-3, np.radians(0.3), 0.1e-3
ZEROS = np.radians(0.6)  # half of the width of a uniform distribution
READINGS = Spread(float(np.radians(0.05)), Distribution.NORMAL)
FOCAL = 0.03


@dataclass(frozen=True)
class Outcome:
    """What a session said."""

    wrong: str  # the motor with a horn a tooth off; "" without one
    named: tuple[str, ...] = ()
    squares: tuple[float, ...] = ()
    refusal: str = ""

    @property
    def right(self) -> bool:
        """Whether it names the wrong motor and no other."""
        return not self.refusal and self.named == ((self.wrong,) if self.wrong else ())


def true_machine(nominal: Machine, rng: np.random.Generator, folder: Path) -> Machine:
    """Write and return a machine whose parts err by their tolerances, all zeros right."""
    columns, legs, n = LegColumns, geometries(nominal), nominal.n_legs
    place = np.arange(n * columns.COUNT).reshape(n, -1)
    place[:, columns.ACTUATOR] = place[list(reading_legs(legs))][:, columns.ACTUATOR]
    sigma = np.zeros(columns.COUNT)
    sigma[:6], sigma[columns.LENGTH] = JOINTS, LENGTHS
    sigma[12:14], sigma[14:16] = AXES, JOINTS
    step = (rng.normal(size=(n, columns.COUNT)) * sigma).ravel()
    moved = in_joint_frames(moved_legs(legs, place, step), nominal.frame_legs)
    home = home_of_legs(nominal, moved, 0.2)
    assert home is not None
    return load_mechanism(write_model_with(nominal, moved, home, folder, {}))


def session(seed: int, options: argparse.Namespace, folder: Path) -> tuple[dict[str, float], str]:
    """Write a session; return by motor how much further it stands than it reads, and the wrong."""
    rng = np.random.default_rng(seed)
    nominal = load_mechanism(options.model)
    true = true_machine(nominal, rng, folder / "truth")
    motors = [true.legs[j].motor_label for j in true.motors]
    zeros = rng.uniform(-ZEROS, ZEROS, len(motors))
    wrong = int(rng.integers(len(motors))) if seed % 2 else None
    if wrong is not None:
        zeros[wrong] += rng.choice([-1.0, 1.0]) * 2.0 * np.pi / TEETH
    n_poses = int(rng.integers(1, 4))
    poses = list[Array]()
    while len(poses) < n_poses:
        q = draw_poses(true, 1, rng, "workspace").readings[0, list(true.motors)]
        travel = np.array([true.legs[j].travel for j in true.motors])
        if np.all((q - zeros > travel[:, 0]) & (q - zeros < travel[:, 1])):
            poses.append(q)
    rows, views = list[tuple[str, str, str]](), {}
    (folder / "images").mkdir(parents=True)
    look = Appearance(camera="phone", colour=CAMERAS["phone"].colour)
    outlines = list[list[str]]()
    for k in range(options.images):
        one, p = folder / f"one{k}", k % n_poses
        (folder / "pose.csv").write_text(
            ",".join(str(true.legs[j].prismatic) for j in true.motors)
            + "\n"
            + ",".join(map(repr, poses[p].tolist()))
            + "\n"
        )
        settings = SimulationSettings(
            level=options.level,
            seed=1000 * seed + k,
            errors=ParameterErrors(),
            poses=folder / "pose.csv",
            views=1,
            hints=options.level == "outlines",  # whose cameras nobody recognises
            tell_gamma=False,
            appearance=look,
            sigma_px=0.3,
            readings=Spread(0.0),
        )
        simulate(true, one, settings)
        view = f"c{k + 1}"
        made = yaml.safe_load((one / "dataset.yaml").read_text())["views"]["c1"]
        views[view] = {**made, "camera": "camera_info.yaml"}
        if options.level == "photographs":
            view, views = f"phone-{k + 1}", {"phone": {**made, "camera": "camera_info.yaml"}}
            views["phone"]["hand_held"] = True
        image = ""
        if options.level == "photographs":
            file = next((one / "images").iterdir())
            image = f"images/{view}{file.suffix}"
            shutil.copy(file, folder / image)
        else:
            with (one / "observations.csv").open() as table:
                for i, row in enumerate(csv.reader(table)):
                    if i == 0 and not outlines:
                        outlines.append(row)
                    elif i > 0:
                        outlines.append([view, f"p{p + 1}", *row[2:]])
        shutil.rmtree(one)
        rows.append((view.partition("-")[0], image, f"p{p + 1}"))
    sigma = READINGS.size
    read = [q - zeros + sigma * rng.normal(size=len(q)) for q in poses]
    with (folder / "measurements.csv").open("w") as table:
        writer = csv.writer(table)
        writer.writerow(["view", "image", "pose", *(true.legs[j].prismatic for j in true.motors)])
        for view, image, pose in rows:
            writer.writerow([view, image, pose, *read[int(pose[1:]) - 1].tolist()])
    if outlines:
        with (folder / "observations.csv").open("w") as table:
            csv.writer(table).writerows(outlines)
    lens = mild_lens()
    off = 1.0 + FOCAL * float(np.clip(rng.normal(), -2.0, 2.0)) * (options.level == "photographs")
    sigmas = {"fx": FOCAL * lens.K[0, 0], "fy": FOCAL * lens.K[1, 1]}
    names = list(intrinsic_names(lens))
    stated = np.array([sigmas.get(name, 0.0) for name in names])
    C = np.outer(stated, stated)
    K = lens.K @ np.diag([off, off, 1.0])
    camera = {
        "image_width": lens.width,
        "image_height": lens.height,
        "camera_name": "phone",
        "camera_matrix": {"rows": 3, "cols": 3, "data": K.ravel().tolist()},
        "distortion_model": lens.model,
        "distortion_coefficients": {
            "rows": 1,
            "cols": len(lens.distortion),
            "data": lens.distortion.tolist(),
        },
        "legcal_camera": {"version": 1, "names": names, "covariance": C.tolist()},
    }
    (folder / "camera_info.yaml").write_text(yaml.safe_dump(camera))
    document = {
        "legcal_dataset": 1,
        "mechanism": options.model,
        "measurements": "measurements.csv",
        "encoder_sigma": dict.fromkeys([str(true.legs[j].prismatic) for j in true.motors], sigma),
        "views": views,
        "tolerance": {
            "joints": JOINTS,
            "axes": float(AXES),
            "lengths": LENGTHS,
            "zeros": float(ZEROS) / 3**0.5,
        },
        "spline_teeth": TEETH,
    }
    (folder / "dataset.yaml").write_text(yaml.safe_dump(document))
    return dict(zip(motors, zeros.tolist(), strict=True)), "" if wrong is None else motors[wrong]


def outcome(seed: int, options: argparse.Namespace, folder: Path) -> Outcome:
    """Make and calibrate a session."""
    zeros, wrong = session(seed, options, folder)
    try:
        found = calibrate(folder, only="zeros", use_cache=False)
    except LegcalError as error:
        return Outcome(wrong, refusal=" ".join(error.problems))
    group = found.group
    assert group is not None
    named = tuple(zero.motor for zero in group.zeros if zero.teeth)
    squares = tuple(((zero.value - zeros[zero.motor]) / zero.sigma) ** 2 for zero in group.zeros)
    if options.verbose:
        print(f"     {found.verdict.sentence}")
        for zero in group.zeros:
            numbers = np.degrees([zero.value, zero.sigma, zeros[zero.motor]])
            print("     {} {:+.2f} ± {:.2f} deg, truly {:+.2f}".format(zero.motor, *numbers))
    return Outcome(wrong, named, squares)


def main() -> None:
    """Print a line a session, and a summary."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, nargs=2, default=(1, 50), help="first and last; 1 50")
    parser.add_argument("--level", choices=("outlines", "photographs"), default="outlines")
    parser.add_argument("--model", default="servo-hexapod")
    parser.add_argument("--images", type=int, default=5, help="5")
    parser.add_argument("--keep", type=Path, help="where sessions stay")
    parser.add_argument("--verbose", action="store_true", help="verdicts, and zeros [deg]")
    options = parser.parse_args()
    found = list[Outcome]()
    with TemporaryDirectory() as scratch:
        for seed in range(options.seeds[0], options.seeds[1] + 1):
            folder = (options.keep or Path(scratch)) / f"{options.level}-{seed}"
            shutil.rmtree(folder, ignore_errors=True)
            one = outcome(seed, options, folder)
            found.append(one)
            print(
                f"{seed:4d} {one.wrong or '-':>8} named {', '.join(one.named) or '-':8} "
                f"{'right' if one.right else 'WRONG':6} nse {np.mean(one.squares or [np.nan]):.2f} "
                f"{one.refusal}",
                flush=True,
            )
    for kind, some in (
        ("a tooth off", [one for one in found if one.wrong]),
        ("no tooth off", [one for one in found if not one.wrong]),
    ):
        right = sum(one.right for one in some)
        refused = sum(bool(one.refusal) for one in some)
        print(f"{kind}: {right} of {len(some)} right, {refused} refused")
    squares = [square for one in found for square in one.squares]
    print(f"nse of {len(squares)} zeros: {np.mean(squares or [np.nan]):.2f}")


if __name__ == "__main__":
    main()
