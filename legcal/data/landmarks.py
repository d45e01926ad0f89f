"""The table ``landmarks.csv``: joints that a person clicked in photographs, and cameras from them.

One row a click: view and image, named as in ``observations.csv``; the joint, ``leg1.base`` or
``leg1.platform``; its pixel in the stored photograph; the standard deviation of that [px], 3 where
the cell is empty. The nominal model gives the joints at the readings of the image, so that four of
them place the camera of the view: roughly, like a ``T_base_camera`` in the dataset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.data.image_tables import ImageTable
from legcal.data.measurements import (
    Measurements,
    View,
    find_rows,
    places,
    refuse_outside,
    row_names,
)
from legcal.errors import DatasetError
from legcal.files.table import Column, format_table, read_table
from legcal.geometry.types import Array, BoolArray, IntArray
from legcal.machine.kinematics import followed_poses
from legcal.machine.model import B_at, Machine
from legcal.vision.point_pose import (
    MIN_POINTS,
    TRUNCATION,
    PointPose,
    camera_poses_by_points,
    on_a_line,
)

LANDMARKS_NAME = "landmarks.csv"
SIGMA_PX = 3.0  # [px] default standard deviation of a click
SIGMA_RANGE = (0.01, 200.0)  # [px] plausible standard deviations of a click
ENDS = ("base", "platform")
COLUMNS = ("view", "image", "joint", "u", "v", "sigma")
GOOD_NUMBER = 6  # clicks in a view, enough to identify a wrong click
# Standard deviation of joints of the nominal model [mean leg lengths]: clicks need not fit better
MODEL_ERROR = 0.015
# Minimum lead in cost of a camera pose over the next one: half a squared standard deviation
MIN_LEAD = 4.5
# Maximum standard deviations of a rough pose, whose errors may be three times as large: angle, and
# fraction of the distance
MAX_ANGLE, MAX_SHIFT = np.deg2rad(6.0), 0.06


@brief
@dataclass(frozen=True, eq=False)
class Landmarks(ImageTable):
    """Joints clicked in images, one row a click."""

    keys = "row", "leg", "end"
    leg: IntArray  # (n,)
    end: IntArray  # (n,) 0 at the base, 1 at the platform: index into ENDS
    px: Array  # (n, 2) where it is seen [px]; (0, 0) is the centre of the top-left pixel
    sigma_px: Array  # (n,) of either coordinate


def joint_names(leg_names: Sequence[str]) -> dict[str, tuple[int, int]]:
    """Return leg and end of each joint, by its name in the table."""
    return {joint_name(leg, end): (j, end) for end in (0, 1) for j, leg in enumerate(leg_names)}


def joint_name(leg: str, end: int) -> str:
    """Return the name of a joint in the table."""
    return f"{leg}.{ENDS[end]}"


def format_landmarks(
    landmarks: Landmarks, measurements: Measurements, leg_names: Sequence[str]
) -> str:
    """Return the text of ``landmarks.csv``."""
    names = places(measurements)
    return format_table(
        COLUMNS,
        (
            [*names[row], joint_name(leg_names[leg], end), *px, sigma]
            for (row, leg, end), px, sigma in zip(
                landmarks.row_keys(),
                landmarks.px.tolist(),
                landmarks.sigma_px.tolist(),
                strict=True,
            )
        ),
    )


def read_landmarks(path: Path, leg_names: Sequence[str], measurements: Measurements) -> Landmarks:
    """Return the table ``landmarks.csv`` in the order of the file.

    Raises DatasetError with one sentence for each problem.
    """
    least, most = SIGMA_RANGE
    needed = f"a standard deviation from {least:g} to {most:g} px"
    table = read_table(
        path,
        "table of landmarks",
        "landmark",
        [
            *(Column(name, "text") for name in COLUMNS[:3]),
            *(Column(name, what="pixel", unit="pixels") for name in COLUMNS[3:5]),
            Column(COLUMNS[5], least=least, most=most, needed=needed, blank=True, required=False),
        ],
        needed="joints that are clicked in pictures; add them, or delete the file",
    )
    row = find_rows(table, measurements)
    joints = joint_names(leg_names)
    joint = table.positions("joint", [*joints], "a joint of the mechanism, as leg1.base")
    px = table.numbers(("u", "v"))
    refuse_outside(table, row, COLUMNS[3:5], measurements)
    table.once(
        [key if min(key) >= 0 else None for key in zip(row.tolist(), joint.tolist(), strict=True)],
        "the same image and joint",
    )
    table.check()
    leg, end = np.array([*joints.values()], dtype=np.intp)[joint].T
    sigma = table.number("sigma") if "sigma" in table else np.full(len(table), np.nan)
    return Landmarks(row, leg, end, px, np.where(np.isfinite(sigma), sigma, SIGMA_PX))


def place_by_landmarks(
    path: Path,
    machine: Machine,
    measurements: Measurements,
    landmarks: Landmarks,
    *,
    may_be_wrong: bool = False,
) -> tuple[Measurements, list[str]]:
    """Place the views with clicks by these, and return the measurements and notes on such views.

    The clicks of a view take precedence over its ``T_base_camera``. If they *may_be_wrong*, a
    problem is a note, and the view stays as it is.
    """
    views, problems, notes = list(measurements.views), list[str](), list[str]()
    for v, clicked_camera in cameras_by_landmarks(path, machine, measurements, landmarks).items():
        problems += clicked_camera.problems
        notes += clicked_camera.notes
        if clicked_camera.T_base_camera is not None and not clicked_camera.problems:
            views[v] = replace(
                views[v],
                T_base_camera=clicked_camera.T_base_camera,
                by_landmarks=True,
                is_placed=clicked_camera.is_sure,
            )
    if problems and not may_be_wrong:
        raise DatasetError(problems)
    return replace(measurements, views=tuple(views)), [*problems, *notes]


@dataclass(frozen=True, eq=False)
class ClickedCamera:
    """The camera of a view by its clicks."""

    # From all clicks that are not wrong; None where they do not place the camera
    T_base_camera: RigidTransform | None
    problems: list[str]  # wrong or missing clicks
    notes: list[str]  # ambiguity or uncertainty of the pose
    n_agreeing: int  # clicks that agree with the pose

    @property
    def is_sure(self) -> bool:
        """Whether so many clicks agree on one camera that images need not find it again."""
        return not (self.problems or self.notes) and self.n_agreeing >= GOOD_NUMBER


def cameras_by_landmarks(
    path: Path, machine: Machine, measurements: Measurements, landmarks: Landmarks
) -> dict[int, ClickedCamera]:
    """Return the cameras of the views that have clicks, by their index."""
    joints, has_place = joints_at_readings(machine, measurements, landmarks.row)
    view_of, cameras = measurements.view[landmarks.row], dict[int, ClickedCamera]()
    for v in np.unique(view_of).tolist():
        of_view = view_of == v
        clicks = _Clicks(
            **vars(landmarks.choose(of_view)),
            joints=joints[of_view],
            has_place=has_place[of_view],
            path=path,
            machine=machine,
            measurements=measurements,
            view=measurements.views[v],
        )
        cameras[v] = clicks.camera()
    return cameras


def platforms_by_landmarks(
    machine: Machine, measurements: Measurements, landmarks: Landmarks
) -> dict[int, tuple[RigidTransform, ...]]:
    """Return T_base_platform of poses whose images have clicks on the platform, likeliest first.

    They rely on the rough cameras of their views; images with fewer than four such clicks give
    none.
    """
    candidates = dict[int, list[tuple[float, RigidTransform]]]()
    B, on_platform = machine.B_platform, landmarks.end == 1
    for row in np.unique(landmarks.row).tolist():
        view = measurements.views[int(measurements.view[row])]
        image_clicks = landmarks.choose((landmarks.row == row) & on_platform)
        points = B[image_clicks.leg]
        if view.T_base_camera is None or len(image_clicks) < MIN_POINTS or on_a_line(points):
            continue
        of_pose = candidates.setdefault(int(measurements.pose[row]), [])
        for camera_pose in camera_poses_by_points(
            view.camera, points, image_clicks.px, image_clicks.sigma_px
        )[:2]:
            of_pose.append((camera_pose.cost, view.T_base_camera * camera_pose.T_camera_base))
    return {
        pose: tuple(T for _, T in sorted(of_one_pose, key=lambda camera_pose: camera_pose[0]))
        for pose, of_one_pose in candidates.items()
        if of_one_pose
    }


def joints_at_readings(
    machine: Machine, measurements: Measurements, rows: IntArray
) -> tuple[Array, BoolArray]:
    """Return the joints in the base link at the readings of rows [m], and which have a place.

    Joints (n, n_legs, 2, 3) have a place (n, n_legs, 2) if the readings give it: only those at the
    base where the motors do not determine the pose of the platform, or the nominal model does not
    reach it.
    """
    poses, of_row = np.unique(measurements.pose[rows], return_inverse=True)
    q = measurements.q_of_poses[poses]
    joints = np.zeros((len(poses), machine.n_legs, 2, 3))
    joints[:, :, 0] = machine.A_at(np.nan_to_num(q))
    has_place = np.zeros(joints.shape[:3], dtype=np.bool_)
    has_place[:, :, 0] = np.isfinite(q) | [leg.actuator is None for leg in machine.legs]
    if machine.is_determined:
        for k, (T, failure) in enumerate(followed_poses(machine, q, on_the_chain=False)):
            joints[k, :, 1] = B_at(machine, T.as_matrix()[None])[0]
            has_place[k, :, 1] = failure is None
    return joints[of_row], has_place[of_row]


@dataclass(frozen=True, eq=False)
class _Clicks(Landmarks):
    """The clicks of one view, and the joints of their images according to the nominal model."""

    joints: Array  # (n, n_legs, 2, 3)
    has_place: BoolArray  # (n, n_legs, 2)
    path: Path
    machine: Machine
    measurements: Measurements
    view: View

    def camera(self) -> ClickedCamera:
        """Return the likeliest pose of the camera, problems of clicks, and notes."""
        some = self.choose(self.has_place[np.arange(len(self)), self.leg, self.end])
        n, points = len(some), some.points
        sigma, poses = np.zeros(0), list[PointPose]()
        if n >= MIN_POINTS and not on_a_line(points):
            sigma = some.sigma(points)
            poses = camera_poses_by_points(self.view.camera, points, some.px, sigma)
        if not poses:
            return ClickedCamera(None, [self._too_few(n, len(self) - n)], [], 0)
        best = poses[0]
        wrong = np.flatnonzero(best.off_px > TRUNCATION * sigma)
        if 2 * len(wrong) > n or n - len(wrong) < MIN_POINTS:
            return ClickedCamera(None, [some.disagreement(best)], [], 0)
        problems = some.contradictions(best, wrong, sigma)
        notes = [] if problems else some.doubts(poses)
        return ClickedCamera(best.T_camera_base.inv(), problems, notes, n - len(wrong))

    @property
    def points(self) -> Array:
        """The joints by the nominal model, (n, 3) in the base link [m]."""
        return self.joints[np.arange(len(self)), self.leg, self.end]

    def sigma(self, points: Array) -> Array:
        """Return the standard deviation of clicks from the joints of the model, (n,) [px].

        The scale in pixels a metre is the third quartile over pairs of clicks far apart, since some
        pairs are foreshortened.
        """
        i, j = np.triu_indices(len(points), 1)
        apart = np.linalg.norm(points[i] - points[j], axis=1)
        far = apart > 0.3 * apart.max()
        scale = np.linalg.norm(self.px[i] - self.px[j], axis=1)[far] / apart[far]
        of_model = MODEL_ERROR * self.machine.size * float(np.percentile(scale, 75.0))
        return np.hypot(self.sigma_px, of_model)

    def _too_few(self, n: int, left_out: int) -> str:
        """Return the problem of too few clicks to place the camera."""
        actual = f"{n} click{'s' * (n != 1)}" + " on one line" * (n >= MIN_POINTS)
        if left_out:
            actual += f" on joints that the readings place, and {left_out} on others"
        return (
            f"{self.path}: view {self.view.name}: its camera could not be placed: found {actual}, "
            f"needed {MIN_POINTS} or more, better {GOOD_NUMBER}, that are not on one line; click "
            "more joints in its pictures, or remove those of this view."
        )

    def disagreement(self, pose: PointPose) -> str:
        """Return the problem of contradictory clicks, none of which is identified as wrong."""
        return (
            f"{self.path}: view {self.view.name}: its camera could not be placed: found "
            f"{len(self)} clicks that no camera shows where they are (up to "
            f"{pose.off_px.max():.0f} px off), needed clicks on the joints that they name; check "
            "them, the readings of their images, the camera file and the model, or click more "
            "joints."
        )

    def contradictions(self, pose: PointPose, wrong: IntArray, sigma: Array) -> list[str]:
        """Return the problems of clicks that contradict the other clicks."""
        names, sentences = row_names(self.measurements), list[str]()
        for i in wrong.tolist():
            name = joint_name(self.machine.leg_names[self.leg[i]], int(self.end[i]))
            other_joint = self._other_joint(pose, i, TRUNCATION * float(sigma[i]))
            perhaps = f"perhaps it shows {other_joint}; " if other_joint else ""
            sentences.append(
                f"{self.path}: the click on {name} in {names[self.row[i]]} (view {self.view.name}) "
                f"is {pose.off_px[i]:.0f} px from where the other clicks have it, needed at most "
                f"{TRUNCATION * sigma[i]:.0f} px; {perhaps}correct or remove it."
            )
        return sentences

    def _other_joint(self, pose: PointPose, i: int, most: float) -> str:
        """Return the joint that a click fits according to the other clicks; "" for none."""
        keys = np.argwhere(self.has_place[i])
        P = pose.T_camera_base.apply(self.joints[i][self.has_place[i]])
        off = np.full(len(keys), np.inf)
        ahead = P[:, 2] > 0.0
        off[ahead] = np.linalg.norm(self.view.camera.project(P[ahead]) - self.px[i], axis=1)
        k = int(np.argmin(off))
        if off[k] > min(most, 0.5 * float(pose.off_px[i])):
            return ""
        return joint_name(self.machine.leg_names[keys[k, 0]], int(keys[k, 1]))

    def doubts(self, poses: Sequence[PointPose]) -> list[str]:
        """Return notes on an ambiguous or uncertain camera pose."""
        best = poses[0]
        start = f"{self.path}: view {self.view.name}: its {len(self)} clicks"
        distance = float(np.linalg.norm(best.T_camera_base.translation))
        if len(poses) > 1 and poses[1].cost - best.cost < MIN_LEAD:
            difference = best.T_camera_base * poses[1].T_camera_base.inv()
            return [
                f"{start} leave two cameras open, "
                f"{1e3 * np.linalg.norm(difference.translation):.0f} mm and "
                f"{np.degrees(difference.rotation.magnitude()):.0f} deg apart, and the likelier "
                "one is where the search begins; click joints that are nearer or farther as well."
            ]
        turn, shift = (float(np.sqrt(np.trace(best.covariance[s, s])))
                       for s in (slice(3), slice(3, 6)))  # fmt: skip
        if turn <= MAX_ANGLE and shift <= MAX_SHIFT * distance:
            return []
        return [
            f"{start} place the camera to {1e3 * shift:.0f} mm and {np.degrees(turn):.0f} deg "
            "only; click more joints, far from each other."
        ]
