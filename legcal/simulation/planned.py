"""A session that ``legcal plan`` wrote, as it will be shot: tripods a little elsewhere."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legcal.calibration import PLAN_NAME
from legcal.data import Measurements, load_dataset
from legcal.errors import DatasetError, DidNotConverge, UsageError
from legcal.files import read_json
from legcal.geometry import Array
from legcal.machine import Configurations, Machine, follow_each, poses_at
from legcal.planning import Setting
from legcal.simulation.visibility import Viewpoint


@dataclass(frozen=True, eq=False)
class PlannedSession:
    """What a plan asks for."""

    measurements: Measurements  # one row an image, with views where they should stand
    setting: Setting  # how far tripods may be off

    @property
    def poses_of(self) -> list[list[int]]:
        """The poses that each view sees."""
        m = self.measurements
        return [m.pose[m.view == v].tolist() for v in range(len(m.views))]

    def viewpoints(self, rng: np.random.Generator) -> tuple[Viewpoint, ...]:
        """Return the views as tripods are set: elsewhere by the tolerance of the plan at most."""
        found = []
        for view in self.measurements.views:
            T = view.T_base_camera
            if T is None:
                raise UsageError(
                    f"The plan could not be shot: found no T_base_camera of view {view.name}, "
                    "needed where its camera stands; write it into dataset.yaml, or plan again."
                )
            moved = self.setting.camera_elsewhere(T, rng)
            found.append(Viewpoint(view.name, view.camera, moved))
        return tuple(found)

    def poses(self, truth: Machine) -> Configurations:
        """Return the poses of the true machine at the planned readings."""
        m = self.measurements
        reached: list[Array] = []
        try:
            for configuration in follow_each(truth, m.q[m.first_rows][:, list(truth.motors)]):
                reached.append(configuration)
        except DidNotConverge as error:
            raise DidNotConverge(
                f"The plan could not be shot: found that the true machine does not reach pose "
                f"{len(reached) + 1}, needed all of them; draw smaller --error, or plan again."
            ) from error
        return poses_at(truth, reached)


def read_plan(folder: Path, nominal: Machine) -> PlannedSession:
    """Return a planned session of a machine. Raises UsageError if it is none, or of another one."""
    try:
        tolerance = read_json(folder / PLAN_NAME)["tolerance"]
        shift, turn = float(tolerance["camera_m"]), float(tolerance["camera_rad"])
        setting = Setting(shift, turn)
    except (OSError, ValueError, KeyError, TypeError, DatasetError) as error:
        raise UsageError(
            f"{folder}: the plan could not be shot: found no {PLAN_NAME} of legcal in it, needed "
            "the folder that legcal plan wrote; correct --plan."
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
    return PlannedSession(dataset.measurements, setting)
