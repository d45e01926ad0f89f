"""The four steps on a dataset (sections 3.2 to 3.5), and the starts of its joint fit."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from legcal.brief import brief
from legcal.calibration.board import BoardViews, Poses, in_one_camera
from legcal.calibration.joint_fit.variables import Start, start_from
from legcal.calibration.ordered_dataset import Options, OrderedDataset
from legcal.data.image_tables import Order, inverse
from legcal.data.measurements import few_views
from legcal.data.outlines import Outlines, along_legs, axes_from_outlines
from legcal.data.reasons import Reason
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible
from legcal.machine.leg import Leg
from legcal.machine.parameters import geometries, parametrization_of, reframed
from legcal.machine.ties import machine_ties, on_ties
from legcal.paper.four_steps import run_base_steps, run_platform_steps
from legcal.paper.unknowns import nominal_machine
from legcal.perception.placement import Placement


@brief
@dataclass(frozen=True, eq=False)
class Steps:
    """The result of the four steps."""

    legs: tuple[Leg, ...] | None  # in R_b and R_e; None if a step failed
    T_Rb_camera: tuple[RigidTransform | None, ...] | None  # result of step 2; None if it failed
    failure: str  # reason of the failure; "" without one
    diagnostics: tuple[str, ...] = ()  # parts left out or kept at nominal, with the reason

    def in_file_order(self, order: Order) -> Steps:
        """Return a copy with legs and views in the order of the files."""
        legs, cameras = self.legs, self.T_Rb_camera
        return replace(
            self,
            legs=legs and tuple(legs[j] for j in inverse(order.legs).tolist()),
            T_Rb_camera=cameras and tuple(cameras[v] for v in inverse(order.views).tolist()),
        )


def four_steps(
    data: OrderedDataset,
    outlines: Outlines,
    placement: Placement,
    board: BoardViews | None,
    options: Options,
) -> Steps:
    """Run the four steps; a failure is returned, since the joint fit may not need them.

    If only the later steps fail, the result contains the cameras alone. Where the steps are left
    out, they still place the cameras that nothing else does.
    """
    criteria = options.criteria
    if criteria is None and None not in placement.T_base_camera:
        return Steps(None, None, "They were left out.")
    data.progress("Four steps", 0, 1)
    measurements = data.measurements
    try:
        nominal = nominal_machine(data.machine)
        legs = data.machine.legs
        radii = {part: r for leg in legs for part, r in leg.radius_along.items()}
        axes = axes_from_outlines(along_legs(outlines, legs), measurements, radii)
        joined = board is not None and any(T is not None for T in board.T_board_camera)
        if board is not None and joined:
            axes, measurements, T_first_camera, new_view = in_one_camera(
                axes, measurements, board.T_board_camera
            )
        base = run_base_steps(nominal, axes, measurements, criteria=criteria or "default")
        cameras = tuple(base.T_Rb_camera)
        if joined:
            moved = zip([cameras[v] for v in new_view.tolist()], T_first_camera, strict=True)
            cameras = tuple(
                T if T is None or T_first is None else T * T_first for T, T_first in moved
            )
        if criteria is None:
            return Steps(None, cameras, "They were left out.")
        try:
            platform = run_platform_steps(
                base,
                measurements,
                criteria=criteria,
                free_twists=any(name.endswith(".twist") for name in options.choices.free),
            )
        except (NotIdentifiable, DidNotConverge) as failure:
            return Steps(None, cameras, str(failure))
        frame_legs, parametrization = data.machine.frame_legs, parametrization_of(data.machine)
        ties, unit = machine_ties(data.machine), np.ones(len(parametrization))
        legs = on_ties(
            reframed(platform.legs, frame_legs), nominal.legs, ties, parametrization.place, unit
        )
        # legs fixed to the platform have B at the origin of its link
        origin = np.asarray(data.machine.T_platform_Re.inv().translation)
        legs = reframed(legs, frame_legs, origin)
        return Steps(legs, cameras, "", platform.diagnostics)
    except (NotIdentifiable, NotVisible, DidNotConverge) as failure:
        return Steps(None, None, str(failure))
    finally:
        data.progress("Four steps", 1, 1)


def without_lost_images(
    data: OrderedDataset,
    outlines: Outlines,
    placement: Placement,
    steps: Steps,
    board: BoardViews | None,
) -> tuple[Outlines, BoardViews | None]:
    """Reject outlines and corners of single images, from a camera in the hand, that nothing places.

    Other views are needed: :func:`starts` says what would place them. So are images that the board
    places to each other, and all where none is placed.
    """
    staged = steps.T_Rb_camera or placement.T_base_camera
    of_board = placement.T_base_camera if board is None else board.T_board_camera
    places = zip(placement.T_base_camera, staged, of_board, strict=True)
    in_hand = np.array([view.hand_held for view in data.measurements.views], dtype=np.bool_)
    is_lost = in_hand & [all(T is None for T in of_view) for of_view in places]
    if np.array_equal(is_lost, in_hand):
        return outlines, board
    lost = is_lost[data.measurements.view]
    if board is not None and lost.any():
        of_lost = np.isin(board.corners.row, data.rows[lost])
        board = replace(board, corners=board.corners.reject(of_lost, Reason.NOT_PLACED))
    return outlines.reject(lost[outlines.row], Reason.NOT_PLACED), board


def starts(
    data: OrderedDataset,
    outlines: Outlines,
    placement: Placement,
    steps: Steps,
    board: BoardViews | None,
) -> list[Start]:
    """Return the starts of the joint fit: nominal, and the result of the four steps if any.

    Raises NotIdentifiable if neither placement nor steps locate a camera that is needed.
    """
    machine = data.machine
    rough = [None if T is None else T.inv() * machine.T_base_Rb for T in placement.T_base_camera]
    staged = [None if T is None else T.inv() for T in steps.T_Rb_camera or [None] * len(rough)]
    by_label = {"nominal": (geometries(machine), rough, staged)}
    if steps.legs is not None:
        by_label["staged"] = (steps.legs, staged, rough)
    start_list = []
    for label, (legs, first, second) in by_label.items():
        cameras = _start_cameras(data, outlines, first, second, steps, board)
        start = start_from(legs, data.measurements, data.fitted_legs, cameras, data.T_Rb_Re, label)
        if board is not None:
            T_Rb_camera = [T.inv() for T in cameras]
            T_Rb_board = board.pose_by_cameras(T_Rb_camera)
            start = start if T_Rb_board is None else replace(start, T_Rb_board=T_Rb_board)
            T_Re_board = board.pose_on_platform(data, T_Rb_camera, start.T_Rb_Re)
            start = start if T_Re_board is None else replace(start, T_Re_board=T_Re_board)
        start_list.append(start)
    return start_list


def _start_cameras(
    data: OrderedDataset,
    outlines: Outlines,
    first: Poses,
    second: Poses,
    steps: Steps,
    board: BoardViews | None,
) -> list[RigidTransform]:
    """Return a camera pose for every view, from *first* if it has one, else from *second*."""
    cameras = [a if a is not None else b for a, b in zip(first, second, strict=True)]
    needed = set(data.measurements.view[outlines.row[outlines.used]].tolist())
    if board is not None:
        on_platform = [row in board.T_camera_board for row in data.rows.tolist()]
        needed |= set(data.measurements.view[on_platform].tolist())
    unknown = [
        view for v, view in enumerate(data.measurements.views) if v in needed and cameras[v] is None
    ]
    if unknown:
        remedies = ["add a rough T_base_camera to dataset.yaml"]
        if all(view.hand_held for view in unknown):  # such a view has none
            remedies = [] if data.dataset.board_on("base") else ["put a board on the base"]
        if data.dataset.board_on("base"):
            remedies.append("add a rough T_base_board to the block board of dataset.yaml")
        raise NotIdentifiable(
            f"{few_views([view.name for view in unknown])}: no camera could be placed: found no "
            "T_base_camera, and the four steps do not locate it "
            f"({steps.failure or 'fewer than three base joints are seen'}); needed one of them; "
            f"{', or '.join(remedies)}."
        )
    return [T if T is not None else RigidTransform.identity() for T in cameras]
