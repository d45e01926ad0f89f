"""Figures of a calibration: residuals over the field of the views, and standard deviations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from legcal.calibration.documents import Result
from legcal.calibration.quantities import Quantity, parameters_of
from legcal.errors import UsageError
from legcal.figures import new_figure, plain
from legcal.geometry.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from legcal.calibration.joint_fit.held_out import Posterior

_ARROW = 0.06  # length of the arrow of a residual of three rms, relative to the image width
_WIDTH, _HEIGHT = 4.5, 3.8  # size of a panel [inch]
_COLUMNS = 3  # largest number of columns
_LINE = 0.16  # height of a bar [inch]


def plot_residuals(posterior: Posterior) -> Figure:
    """Plot the residuals of used outlines over the field of each view.

    An arrow at each end of an outline points from its predicted to its measured position.

    Raises
    ------
    UsageError
        If the fit is from axes or corners, without outlines.
    """
    outlines, cameras = posterior.problem.outlines, posterior.state.cameras
    if not len(outlines):
        raise UsageError(
            "The residuals could not be drawn: found a fit without outlines, needed one from "
            "photographs or outlines; look at .summary() for how well it fits."
        )
    offsets = posterior.problem.offsets(posterior.state)
    direction = _directions(posterior)
    rms = float(np.sqrt(np.mean(offsets**2)))
    views = np.unique(outlines.view).tolist()
    with new_figure(len(views), _COLUMNS, (_WIDTH, _HEIGHT)) as (figure, panels):
        for panel, view in zip(panels, views, strict=False):
            of_view = outlines.view == view
            camera, view_offsets = cameras[view], offsets[of_view]
            scale = _ARROW * camera.width / max(3.0 * rms, 1e-9)
            for end in range(2):
                arrows = scale * view_offsets[:, end, None] * direction[of_view]
                panel.quiver(
                    *outlines.pixels[of_view, end].T, *arrows.T, outlines.leg[of_view],
                    angles="xy", scale_units="xy", scale=1.0, width=0.004, cmap="tab10",
                )  # fmt: skip
            panel.set_xlim(-0.5, camera.width - 0.5)
            panel.set_ylim(camera.height - 0.5, -0.5)
            panel.set_aspect("equal")
            name, size = plain(outlines.views[view]), float(np.sqrt(np.mean(view_offsets**2)))
            panel.set_title(f"{name}: {size:.3f} px rms", fontsize="medium")
        figure.suptitle(f"Outlines less the fit, a colour a leg; arrows {scale:.0f} times as long")
    return figure


def _directions(posterior: Posterior) -> Array:
    """Return the direction of positive offsets of each outline, unit vectors (n, 2).

    By eq (3), h . M = epsilon R, the axis is on the positive side of edges of epsilon +1.
    """
    outlines, state = posterior.problem.outlines, posterior.state
    along = outlines.pixels[:, 1] - outlines.pixels[:, 0]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    n_poses, n_legs = len(state.platform_pose.t), len(state.legs)
    ends = state.ends_at_poses[1].reshape(3, n_poses, n_legs)[:, outlines.pose, outlines.leg].T
    middle = 0.5 * (state.A[outlines.leg] + ends)
    R, t = (frames[outlines.view] for frames in state.camera_pose)
    axis = (R @ middle[..., None])[..., 0] + t
    pixel = np.array(
        [
            state.cameras[view].project(point[None])[0]
            for view, point in zip(outlines.view.tolist(), axis, strict=True)
        ]
    )
    inward = np.sum((pixel - outlines.pixels[:, 0]) * normal, axis=1)
    return np.asarray(normal * np.sign(outlines.epsilon * inward)[:, None])


def plot_uncertainty(result: Result) -> Figure:
    """Plot the standard deviations of all parameters, and of the platform at poses."""
    quantities = parameters_of(result)
    groups = [
        (unit, shown)
        for unit in ("mm", "deg")
        if (shown := [q for q in quantities if q.unit == unit and q.sigma])
    ]
    platform = result.platform
    n = len(groups) + (platform is not None)
    longest = max((len(shown) for _, shown in groups), default=0)
    with new_figure(n, n, (_WIDTH, max(_HEIGHT, _LINE * longest))) as (figure, panels):
        for panel, (unit, shown) in zip(panels, groups, strict=False):
            _bars(panel, shown)
            panel.set_xlabel(f"1 sigma [{unit}]")
        if platform is not None:
            panel = panels[n - 1]
            number = np.arange(1, len(platform.per_pose) + 1)
            for values, label in (
                ([p.change_dX_m for p in platform.per_pose], "change against the nominal model"),
                ([p.sigma_dX_m for p in platform.per_pose], "predicted error (1 sigma)"),
            ):
                panel.semilogy(number, 1e3 * np.array(values), ".-", label=label)
            panel.set_xlabel("pose")
            panel.set_ylabel("platform [mm]")
            panel.legend(fontsize="small")
    return figure


def _bars(panel: Axes, quantities: list[Quantity]) -> None:
    """Draw a bar for each parameter, the first at the top."""
    panel.barh(range(len(quantities)), [q.sigma or 0.0 for q in quantities])
    panel.set_yticks(
        range(len(quantities)), [plain(q.name) for q in quantities], fontsize="x-small"
    )
    panel.invert_yaxis()
    panel.margins(y=0.01)
