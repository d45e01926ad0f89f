"""A session that ``legcal plan`` wrote, as it will be shot: tripods a little elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from legcal.data import Measurements, load_dataset
from legcal.errors import DatasetError, DidNotConverge, UsageError
from legcal.files import read_json
from legcal.machine import Configurations, Machine, follow, poses_at, slider_columns
from legcal.simulation.visibility import Viewpoint

PLAN = "plan.json"  # of the session that is shot


@dataclass(frozen=True, eq=False)
class PlannedSession:
    """What a plan asks for."""

    measurements: Measurements  # one row an image, with views where they should stand
    shift: float  # how far tripods may be off [m]
    turn: float  # [rad]

    @property
    def poses_of(self) -> list[list[int]]:
        """The poses that each view sees."""
        m = self.measurements
        return [m.pose[m.view == v].tolist() for v in range(len(m.views))]

    def viewpoints(self, rng: np.random.Generator) -> tuple[Viewpoint, ...]:
        """Return the views as tripods are set: elsewhere by the tolerance of the plan at most."""
        found = []
        for view in self.measurements.views:
            shift, turn = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
            by = rng.random(2) * (self.shift, self.turn)
            T = view.T_base_camera
            if T is None:
                raise UsageError(
                    f"The plan could not be shot: found no T_base_camera of view {view.name}, "
                    "needed where its camera stands; write it into dataset.yaml, or plan again."
                )
            moved = RigidTransform.from_components(
                T.translation + by[0] * shift, Rotation.from_rotvec(by[1] * turn) * T.rotation
            )
            found.append(Viewpoint(view.name, view.camera, moved))
        return tuple(found)

    def poses(self, truth: Machine) -> Configurations:
        """Return the poses of the true machine at the planned readings.

        Each is followed from the nearest one that is reached already, or from home.
        """
        m, motors = self.measurements, list(truth.motors)
        columns = slider_columns(truth, motors)[0]
        reached = [truth.home_configuration]
        for row, q in enumerate(m.q[m.first_rows][:, motors]):
            far = [float(np.abs(c[columns] - q).max()) for c in reached]
            try:
                reached.append(follow(truth, reached[int(np.argmin(far))], q))
            except DidNotConverge as error:
                raise DidNotConverge(
                    f"The plan could not be shot: found that the true machine does not reach pose "
                    f"{row + 1}, needed all of them; draw smaller --error, or plan again."
                ) from error
        return poses_at(truth, reached[1:])


def read_plan(folder: Path, nominal: Machine) -> PlannedSession:
    """Return a planned session of a machine. Raises UsageError if it is none, or of another one."""
    try:
        tolerance = read_json(folder / PLAN)["tolerance"]
        shift, turn = float(tolerance["camera_m"]), float(tolerance["camera_rad"])
    except (OSError, ValueError, KeyError, TypeError, DatasetError) as error:
        raise UsageError(
            f"{folder}: the plan could not be shot: found no {PLAN} of legcal in it, needed the "
            "folder that legcal plan wrote; correct --plan."
        ) from error
    dataset = load_dataset(folder, check_images=False)
    if dataset.machine.leg_names != nominal.leg_names or not np.allclose(
        dataset.machine.A_base, nominal.A_base
    ):
        raise UsageError(
            f"{folder}: the plan could not be shot: found that it is of another machine "
            f"({dataset.machine.name}), needed one of {nominal.name}; correct MODEL or --plan."
        )
    if not nominal.is_determined:
        raise UsageError(
            f"{folder}: the plan could not be shot: found a machine whose readings do not tell its "
            "pose, needed one whose do; simulate it without --plan."
        )
    return PlannedSession(dataset.measurements, shift, turn)
