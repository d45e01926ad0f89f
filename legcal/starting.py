"""Where the fit of everything begins: the nominal model, and what the four steps find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scipy.spatial.transform import RigidTransform

from legcal.board_views import BoardViews
from legcal.calibration import Steps
from legcal.errors import DidNotConverge, NotIdentifiable, NotVisible
from legcal.mechanism.parametrization import geometries
from legcal.observations.leg_axes import axes_from_outlines
from legcal.observations.one_camera import in_one_camera
from legcal.observations.outlines import Outlines
from legcal.observations.view_names import few_views
from legcal.photographs import Scene
from legcal.progress import Report
from legcal.refinement.start import Start, start_from
from legcal.stages.nominal import nominal_mechanism
from legcal.stages.run import run_base_steps, run_platform_steps
from legcal.workpiece import Workpiece


def four_steps(
    work: Workpiece, outlines: Outlines, board: BoardViews | None, progress: Report
) -> Steps:
    """Return what the four steps give, or why they give nothing: the fit may do without."""
    if work.criteria is None:
        return Steps(None, None, "They were left out.")
    progress("Four steps", 0, 1)
    try:
        return _stepped(work, outlines, board)
    except (NotIdentifiable, NotVisible, DidNotConverge) as failure:
        return Steps(None, None, str(failure))
    finally:
        progress("Four steps", 1, 1)


def _stepped(work: Workpiece, outlines: Outlines, board: BoardViews | None) -> Steps:
    """Return what the steps give; cameras alone where only the later steps fail."""
    axes, measurements = work.axes, work.measurements
    if axes is None:
        radii = {part: r for leg in work.mechanism.legs for part, r in leg.radius_of_part.items()}
        axes = axes_from_outlines(outlines, measurements, radii)
    joined = None if board is None else in_one_camera(axes, measurements, board.T_board_camera)
    if joined is not None:
        axes, measurements = joined.axes, joined.measurements
    nominal, criteria = nominal_mechanism(work.mechanism), work.criteria or "default"
    legs, failure = None, ""
    diagnostics: tuple[str, ...] = ()
    base = run_base_steps(nominal, axes, measurements, criteria=criteria)
    try:
        found = run_platform_steps(
            nominal,
            axes,
            measurements,
            base,
            criteria=criteria,
            transformation=work.transformation,
            free_twists=any(name.endswith(".twist") for name in work.choices.free),
        )
        legs, diagnostics = found.legs, found.diagnostics
    except (NotIdentifiable, DidNotConverge) as error:
        failure = str(error)
    cameras = base.T_Rb_camera if joined is None else joined.cameras(base.T_Rb_camera)
    return Steps(legs, cameras, failure, diagnostics)


def starts_of_fit(
    work: Workpiece,
    outlines: Outlines,
    scene: Scene,
    steps: Steps,
    board: BoardViews | None,
) -> list[Start]:
    """Return the starts of the fit: the nominal model, and the steps where they gave a result."""
    mechanism = work.mechanism
    legs = geometries(mechanism)
    platform = work.reached.T_Rb_Re
    rough = [None if T is None else T.inv() * mechanism.T_base_Rb for T in scene.T_base_camera]
    staged = [None if T is None else T.inv() for T in steps.T_Rb_camera or [None] * len(rough)]
    starts = [(legs, _cameras(work, outlines, rough, staged, steps), "nominal")]
    if steps.legs is not None:
        starts.append((steps.legs, _cameras(work, outlines, staged, rough, steps), "staged"))
    found = [
        start_from(legs, work.measurements, work.fitted_legs, cameras, platform, label)
        for legs, cameras, label in starts
    ]
    return found if board is None else [_with_board(start, board) for start in found]


def _with_board(start: Start, board: BoardViews) -> Start:
    """Return a start with the board where its cameras see it."""
    T_Rb_board = board.placed([T.inv() for T in start.T_camera_Rb])
    return start if T_Rb_board is None else replace(start, T_Rb_board=T_Rb_board)


def _cameras(
    work: Workpiece,
    outlines: Outlines,
    first: Sequence[RigidTransform | None],
    second: Sequence[RigidTransform | None],
    steps: Steps,
) -> list[RigidTransform]:
    """Return a camera pose for every view, the first choice where there is one."""
    cameras = [a if a is not None else b for a, b in zip(first, second, strict=True)]
    shown = outlines.row[outlines.used] if work.axes is None else work.axes.row
    needed = set(work.measurements.view[shown].tolist())
    unknown = [
        view.name
        for v, view in enumerate(work.measurements.views)
        if v in needed and cameras[v] is None
    ]
    if unknown:
        raise NotIdentifiable(
            f"{few_views(unknown)}: no camera could be placed: found no "
            "T_base_camera, and the four steps do not locate it "
            f"({steps.failure or 'fewer than three base joints are seen'}); needed one of them; "
            "add a rough T_base_camera to dataset.yaml"
            + (", or T_base_board to its block board." if work.dataset.board else ".")
        )
    return [T if T is not None else RigidTransform.identity() for T in cameras]
