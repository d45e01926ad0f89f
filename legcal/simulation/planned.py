"""A session planned by ``legcal plan``, with the actual tripods a little off the planned poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from legcal.data.dataset import PLAN_NAME, load_dataset
from legcal.data.measurements import Measurements
from legcal.errors import DidNotConverge, NotVisible, UsageError
from legcal.files.reading import read_json
from legcal.files.schema import validate
from legcal.geometry.types import Array
from legcal.machine.configurations import Configurations, poses_at
from legcal.machine.kinematics import follow_each
from legcal.machine.model import Machine
from legcal.planning.places import Setting
from legcal.planning.planned_session import PlanDocument
from legcal.planning.request import difference
from legcal.simulation.board import PlacedBoard
from legcal.simulation.cameras import MAX_HAND_DRAWS
from legcal.simulation.solids import PosedMachine
from legcal.simulation.visibility import Viewpoint


@dataclass(frozen=True, eq=False)
class PlannedSession:
    """A plan: its rows, tolerances, and board."""

    measurements: Measurements  # one row an image, with planned poses of views
    setting: Setting  # tolerances of tripods
    board: PlacedBoard | None  # on the base
    hand: str  # name of the view of a hand-held camera; "" for fixed cameras

    @property
    def poses_of(self) -> list[list[int]]:
        """The poses that each view sees."""
        m = self.measurements
        return [m.pose[m.view == v].tolist() for v in range(len(m.views))]

    def viewpoints(
        self,
        rng: np.random.Generator,
        posed_machines: Sequence[PosedMachine],  # in all poses, with the board
    ) -> tuple[Viewpoint, ...]:
        """Return the views with actual camera poses, within the tolerance of the plan.

        A hand-held camera is moved until it shows the board. Raises NotVisible if it never does.
        """
        viewpoints = []
        for view, poses in zip(self.measurements.views, self.poses_of, strict=True):
            T = view.T_base_camera
            if T is None:
                raise UsageError(
                    f"The plan could not be shot: found no T_base_camera of view {view.name}, "
                    "needed where its camera stands; write it into dataset.yaml, or plan again."
                )
            for _ in range(MAX_HAND_DRAWS if self.hand else 1):
                moved, board = self.setting.perturbed_camera(T, rng), self.board
                if not self.hand or board is None:
                    break
                if board.is_enough(board.seen(posed_machines[poses[0]], view.camera, moved)):
                    break
            else:
                raise NotVisible(
                    f"The plan could not be shot: found that image {view.name} shows the board "
                    f"from none of {MAX_HAND_DRAWS} places near that of the plan, needed all of "
                    "it; plan with a smaller board."
                )
            viewpoints.append(Viewpoint(view.name, view.camera, moved))
        return tuple(viewpoints)

    def poses(self, truth: Machine) -> Configurations:
        """Return the poses of the true machine at the planned readings."""
        m = self.measurements
        reached: list[Array] = []
        try:
            for configuration in follow_each(truth, m.q_of_poses[:, list(truth.motors)]):
                reached.append(configuration)
        except DidNotConverge as error:
            raise DidNotConverge(
                f"The plan could not be shot: found that the true machine does not reach pose "
                f"{len(reached) + 1}, needed all of them; draw smaller --error, or plan again."
            ) from error
        return poses_at(truth, reached)


def read_plan(folder: Path, nominal: Machine) -> PlannedSession:
    """Return a planned session. Raises UsageError if it is invalid, or of another machine."""
    try:
        document = read_json(folder / PLAN_NAME)
        if not isinstance(document, dict) or "legcal_plan" not in document:
            raise ValueError("another document")
        plan = validate(PlanDocument, document, folder / PLAN_NAME)
        places = [view.T_base_camera.motion() for view in plan.views.values()]
        laid = None if plan.T_base_board is None else plan.T_base_board.motion()
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(
            f"{folder}: the plan could not be shot: found no {PLAN_NAME} in it that can be read, "
            "needed the folder that legcal plan wrote; correct --plan."
        ) from error
    tolerance = plan.tolerance
    setting = Setting(
        tolerance.camera_m, tolerance.machine_m, tolerance.camera_rad, tolerance.machine_rad
    )
    dataset = load_dataset(folder, check_images=False)
    if difference_in_words := difference(nominal, dataset.machine):
        raise UsageError(
            f"{folder}: the plan could not be shot: found {difference_in_words}, needed a plan of "
            f"{nominal.name}; correct MODEL or --plan."
        )
    if not nominal.is_determined:
        raise UsageError(
            f"{folder}: the plan could not be shot: found a machine whose readings do not tell its "
            "pose, needed one whose do; simulate it without --plan."
        )
    m, on_base, hand = dataset.measurements, dataset.board_on("base"), ""
    board = None if on_base is None or laid is None else PlacedBoard(on_base.board, laid)
    if any(view.hand_held for view in m.views):
        if board is None or len(places) != len(m.views):
            raise UsageError(
                f"{folder}: the plan could not be shot: found {len(places)} camera places and "
                f"{'no' if board is None else 'a'} place of the board for {len(m.views)} images of "
                f"a camera in the hand, needed one for each image and that of the board in "
                f"{PLAN_NAME}; plan again."
            )
        hand = m.views[0].name.rpartition("-")[0]
        views_and_places = zip(m.views, places, strict=True)
        m = replace(m, views=tuple(replace(view, T_base_camera=T) for view, T in views_and_places))
    return PlannedSession(m, setting, board, hand)
