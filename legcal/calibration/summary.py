"""What a calibration says to people: tables, sentences and charts, from the document."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, overload

import numpy as np

from legcal.calibration.documents import (
    BoardBlock,
    FrameMark,
    Holdout,
    NoSteps,
    PlatformBlock,
    ReadingResiduals,
    Result,
    WorkspaceAccuracy,
)
from legcal.data.reasons import reason_in_words
from legcal.files.quantity import SHOWN_IN
from legcal.machine.leg import Link, ParameterId
from legcal.machine.parameters import list_in_words
from legcal.machine.rods import AT_ZERO
from legcal.pages.document import Number, Table
from legcal.pages.svg import Bars, Canvas, Figure, Points, log_bars, scatter, stacked

FRAMES: dict[str, str] = {"base": "R_b", "platform": "R_e"}
DIGITS = {"mm": 4, "deg": 4, "px": 3, "": 6}  # decimals by unit


def mm_deg(dX_m: float, dE_rad: float) -> str:
    """Return an error of the platform in words."""
    return f"{1e3 * dX_m:.3f} mm / {math.degrees(dE_rad):.4f} deg"


@dataclass(frozen=True)
class Quantity:
    """A number of a machine, and how well it is known."""

    name: str  # as in result.json; ``leg1.base.x`` may be along x of the link or of R_b
    frame: str  # a link, R_b or R_e; "" if independent of a frame
    unit: str  # mm, deg, px or nothing
    value: float
    nominal: float | None = None  # None without a result
    sigma: float | None = None  # None if not estimated
    # estimated, fixed, weak, frame (zero by definition of it), derived (from estimated quantities),
    # or model (without a result)
    status: str = "model"
    defines: FrameMark | None = None  # the part of its frame that the joint defines
    in_frame: float | None = None  # of a joint: the same coordinate in R_b or R_e

    @classmethod
    def of(
        cls,
        name: str,
        frame: str,
        unit: str,
        numbers: tuple[float, float | None, float | None],
        status: str = "model",
        defines: FrameMark | None = None,
    ) -> Quantity:
        """Return a quantity from its value, nominal value and sigma in metres or radians."""
        scale, shown = SHOWN_IN[unit]
        value, *others = numbers
        nominal, sigma = (None if x is None else scale * x for x in others)
        return cls(name, frame, shown, scale * value, nominal, sigma, status, defines)

    @property
    def parameter(self) -> ParameterId:
        """The parsed name."""
        return ParameterId.parse(self.name)

    @property
    def change(self) -> float | None:
        """Value minus nominal."""
        return None if self.nominal is None else self.value - self.nominal

    @property
    def digits(self) -> int:
        """The number of decimals that people are shown."""
        return DIGITS[self.unit]

    @property
    def remark(self) -> str:
        """The status, of a joint with what it defines: ``origin of R_b``, ``defines R_b``."""
        if self.in_frame is None or self.status not in ("frame", "estimated"):
            return self.status
        if self.status == "frame":
            return f"defines {FRAMES[self.parameter.kind]}"
        return "" if self.defines is None else f"{self.defines} of {FRAMES[self.parameter.kind]}"


def parameters_of(result: Result) -> list[Quantity]:
    """Return the parameters of a result that tables have, joints and axes in R_b and R_e."""
    quantities = []
    for row in filter(lambda row: row.is_shown, result.parameters):
        parameter, numbers = ParameterId.parse(row.name), (row.value, row.nominal, row.sigma)
        frame = FRAMES.get(parameter.kind.removesuffix("_axis"), "") if parameter.component else ""
        quantities.append(Quantity.of(row.name, frame, row.unit, numbers, row.status))
    return quantities


def joints_of(result: Result, *sides: Link) -> Iterator[Quantity]:
    """Yield the coordinates of the joints in the links of the model."""
    in_frames = {"base": result.base_joints, "platform": result.platform_joints}
    for side, block in result.links.items():
        in_frame = dict(zip(result.legs, in_frames[side], strict=True))
        for joint in block.joints if side in (sides or FRAMES) else ():
            for k, axis in enumerate("xyz"):
                numbers = joint.xyz[k], joint.nominal[k], joint.sigma[k]
                name, there = f"{joint.leg}.{side}.{axis}", 1e3 * in_frame[joint.leg][k]
                q = Quantity.of(name, block.link, "m", numbers, joint.status[k], joint.defines)
                yield replace(q, in_frame=there)


def turns_of(result: Result) -> Iterator[Quantity]:
    """Yield the turns of the axes of joints from the nominal ones, about the axes of the links."""
    for side, block in result.links.items():
        for turned in block.axes:
            status = "fixed" if turned.sigma is None else "estimated"
            for k, axis in enumerate("xyz"):
                sigma = None if turned.sigma is None else turned.sigma[k]
                name = f"{turned.leg}.{side}_axis.{axis}"
                yield Quantity.of(name, block.link, "rad", (turned.turn[k], 0.0, sigma), status)


_COLUMNS: Mapping[str, Callable[[Quantity], Any]] = {
    "parameter": lambda q: q.name,
    "leg": lambda q: q.parameter.owner,
    "joint": lambda q: q.parameter.kind.replace("_", " "),
    "axis": lambda q: q.parameter.component,
    "link": lambda q: q.frame,
    "nominal": lambda q: q.nominal,
    "calibrated": lambda q: q.value,
    "change": lambda q: q.change,
    "sigma": lambda q: q.sigma,
    "unit": lambda q: q.unit,
    **dict.fromkeys(("in_frame", "in R_b", "in R_e"), lambda q: q.in_frame),
    "status": lambda q: q.remark,
}
_CALIBRATED = ("nominal", "calibrated", "change", "sigma")
NUMBERS = {*_CALIBRATED, "in_frame", "in R_b", "in R_e"}
_IN_LINK = ("leg", "joint", "axis", "link", *_CALIBRATED, "unit")


@dataclass(frozen=True)
class ParameterTable:
    """The parameters of a calibration in mm, degrees and pixels; iterating yields rows as dicts.

    ``pandas.DataFrame(table)`` makes a data frame of it.
    """

    columns: tuple[str, ...]  # keys of ``_COLUMNS``
    quantities: tuple[Quantity, ...]

    @classmethod
    def of(cls, result: Result, *, joints: bool = True) -> ParameterTable:
        """Return the table of a result, joint centres in R_b and R_e or left out."""
        quantities = parameters_of(result)
        some = (q for q in quantities if joints or not q.parameter.is_joint_coordinate)
        return cls(("parameter", *_CALIBRATED, "unit", "status"), tuple(some))

    @classmethod
    def of_joints(cls, result: Result, *sides: Link) -> ParameterTable:
        """Return the joint centres in the links of the model, beside R_b and R_e."""
        return cls((*_IN_LINK, "in_frame", "status"), tuple(joints_of(result, *sides)))

    @classmethod
    def of_axes(cls, result: Result) -> ParameterTable:
        """Return the turns of the axes of joints from the nominal ones, about x, y, z of links."""
        return cls((*_IN_LINK, "status"), tuple(turns_of(result)))

    @property
    def rows(self) -> list[tuple[Any, ...]]:
        """The values of all rows, None where a parameter was not estimated."""
        return [tuple(_COLUMNS[name](q) for name in self.columns) for q in self.quantities]

    def without(self, *columns: str) -> ParameterTable:
        """Return the table without some columns."""
        return replace(self, columns=tuple(c for c in self.columns if c not in columns))

    def __len__(self) -> int:
        return len(self.quantities)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return (self[k] for k in range(len(self)))

    @overload
    def __getitem__(self, row: int) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, row: slice) -> ParameterTable: ...

    def __getitem__(self, row: int | slice) -> dict[str, Any] | ParameterTable:
        if isinstance(row, slice):
            return replace(self, quantities=self.quantities[row])
        return {name: _COLUMNS[name](self.quantities[row]) for name in self.columns}

    def cells(self) -> list[tuple[str, ...]]:
        """Return the rows as texts, the status of estimated parameters left out."""
        return [
            tuple(_cell(name, x, q.digits) for name, x in zip(self.columns, row, strict=True))
            for row, q in zip(self.rows, self.quantities, strict=True)
        ]

    def as_table(self, title: str = "") -> Table:
        """Return the table for a terminal or a page."""
        columns = [f">{name}" if name in NUMBERS else name for name in self.columns]
        rows = [
            [
                Number(x, text) if name in NUMBERS else text
                for name, x, text in zip(self.columns, row, texts, strict=True)
            ]
            for row, texts in zip(self.rows, self.cells(), strict=True)
        ]
        return Table(columns, rows, title)

    def __repr__(self) -> str:
        return aligned(self.columns, self.cells(), NUMBERS)


def aligned(columns: Sequence[str], rows: Sequence[Sequence[str]], numbers: Container[str]) -> str:
    """Return a table as text, columns of numbers flush right."""
    cells = [columns, *rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return "\n".join(
        "  ".join(
            text.rjust(width) if name in numbers else text.ljust(width)
            for name, text, width in zip(columns, row, widths, strict=True)
        ).rstrip()
        for row in cells
    )


def _cell(column: str, x: Any, digits: int) -> str:
    if column == "status":
        return "" if x == "estimated" else str(x)
    if x is None:
        return ""
    if column not in NUMBERS:
        return str(x)
    return f"{x:{'+' if column == 'change' else ''}{'' if column == 'sigma' else 'z'}.{digits}f}"


def tables(result: Result) -> list[tuple[str, ParameterTable]]:
    """Return what a result says of its parameters, each table with its title.

    Joints in the links of base and platform, then all that is no coordinate of a joint.
    """
    found = []
    for side, block in result.links.items():
        joints = ParameterTable.of_joints(result, side).without("joint", "link", "unit")
        columns = tuple(f"in {FRAMES[side]}" if c == "in_frame" else c for c in joints.columns)
        at_zero = AT_ZERO * (result.actuators is not None and side == "base")
        found.append(
            (
                f"Joints of the {side} in the link {block.link}{at_zero} [mm]",
                replace(joints, columns=columns),
            )
        )
    if len(axes := ParameterTable.of_axes(result)):
        without = axes.without("nominal", "calibrated", "unit")
        found.append(("Turns of axes about x, y and z of their links [deg]", without))
    return [*found, ("Other parameters", ParameterTable.of(result, joints=False))]


def sentences(result: Result, *, verbose: bool = False) -> list[str]:
    """Return what a result says beside its parameters, but for the verdict: a line each.

    *verbose* says how the fit went too, and names what moves the platform by nothing.
    """
    notes = [f"Note: {note}" for note in result.notes]
    return [*doubt_lines(result), *notes, *fit_lines(result, verbose=verbose)]


def fit_lines(result: Result, *, verbose: bool) -> list[str]:
    """Return what a fit was made from, how well it fits, and what it leaves open."""
    return [
        *(result.details if verbose else ()),
        *_observation_lines(result),
        *_of_board("base", result.board),
        *_of_board("platform", result.platform_board),
        *_steps_lines(result),
        _fit_line(result),
        *_direction_lines(result),
        *([] if result.platform is None else _platform_lines(result.platform, verbose=verbose)),
        *([] if result.holdout is None else _holdout_lines(result.holdout)),
    ]


def brief_sentences(result: Result) -> list[str]:
    """Return what the first screen says beside the verdict, the platform error and notes."""
    return [
        *doubt_lines(result),
        *_direction_lines(result, 1),
        *_observation_lines(result),
        *([] if result.holdout is None else _holdout_lines(result.holdout)),
    ]


def summary(result: Result) -> str:
    """Return the table of parameters, what it means, and the verdict as one text."""
    shown = [f"{title}\n{table!r}" for title, table in tables(result)]
    return "\n\n".join([*shown, "\n".join(sentences(result)), result.verdict])


def few_lines(name: str, result: Result) -> str:
    """Return what an interactive session shows of a result: at most ten lines."""
    estimated = sum(row.status == "estimated" for row in result.parameters)
    found = [f"{estimated} of {len(result.parameters)} parameters estimated"]
    seen = result.observations
    found.append(f"{seen.used} of {seen.total} outlines of {seen.images} images used")
    found.append(f"{len(result.notes)} note{'s' * (len(result.notes) != 1)}")
    return "\n".join(
        [
            f"{name}: legs {', '.join(result.legs)}" if len(result.legs) < 13 else name,
            f"  {result.verdict}",
            f"  {', '.join(found)}",
            "  more: .summary(), .table(), .joints(), .plot_uncertainty(), .result",
        ]
    )


class Summarised:
    """What every object that has the document of a calibration shows of it."""

    @property
    def result(self) -> Result:
        """The document of ``result.json``."""
        raise NotImplementedError

    def summary(self) -> str:
        """Return the table of parameters [mm, deg, px], what it means, and the verdict."""
        return summary(self.result)

    def table(self) -> ParameterTable:
        """Return the parameters [mm, deg, px]: value, nominal value, change and sigma."""
        return ParameterTable.of(self.result)

    def joints(self) -> ParameterTable:
        """Return joint centres [mm] in the links of base and platform, as ``calibrated.urdf``.

        Beside each stands the coordinate in R_b or R_e. What the definition of the frame fixes has
        no sigma, and its status says so.
        """
        return ParameterTable.of_joints(self.result)

    def plot_uncertainty(self) -> Figure:
        """Return a figure of the standard deviations of parameters, and of the platform."""
        charts = [*parameter_charts(parameters_of(self.result)), *platform_chart(self.result)]
        return stacked("How well the parameters are known", charts).markup()


def doubt_lines(result: Result) -> list[str]:
    """Return what speaks against the result, each with its effect on the platform and its remedy.

    One doubt alone stands in the verdict.
    """
    lines = []
    for doubt in result.doubts if len(result.doubts) > 1 else ():
        effect = ""
        if doubt.sigma_dX_m is not None and doubt.sigma_dE_rad is not None:
            effect = f" ({mm_deg(doubt.sigma_dX_m, doubt.sigma_dE_rad)} at the platform)"
        lines.append(f"Doubt: {doubt.what}{effect}; {doubt.remedy}.")
    return lines


def _observation_lines(result: Result) -> list[str]:
    seen = result.observations
    most = sorted(seen.rejected.items(), key=lambda one: -one[1])[:_MAX_REASONS]
    rejected = ", ".join(f"{count} {reason_in_words(reason)}" for reason, count in most)
    if others := sum(seen.rejected.values()) - sum(count for _, count in most):
        rejected += f", {others} for other reasons"
    lines = [f"Outlines: {seen.used} of {seen.total} used{f'; rejected: {rejected}' * bool(most)}."]
    if seen.total == 0:  # boards are the whole measurement
        lines = ["Outlines: none, no leg was measured."]
    of_views = Counter(image.view for cause in seen.left_out for image in cause.images)
    if of_views:
        counts = list_in_words([f"{n} of {view}" for view, n in of_views.items()])
        n_views = len(of_views)
        lines.append(
            f"Left out: {sum(of_views.values())} of {seen.images} images, in {n_views} "
            f"view{'s' * (n_views != 1)} ({counts})."
        )
    return lines


_MAX_REASONS = 4
_NONE = 5e-4  # [px, mm] and a tenth of it [deg]: would be shown as zero


def _of_board(link: Link, board: BoardBlock | None) -> list[str]:
    which = "" if link == "base" else " on the platform"
    if board is None:
        return []
    line = (
        f"Calibration board{which}: {board.used} of {board.corners} corners used, in "
        f"{board.images} images, {board.rms_px or 0.0:.3f} px rms."
    )
    if board.off is not None:
        line += (
            f" It stands {1e3 * board.off.dX_m:.2f} mm and {np.degrees(board.off.dE_rad):.3f} deg "
            f"from where the dataset has it, if the joints of the {link} stand where the nominal "
            "model has them."
        )
    return [line]


def _steps_lines(result: Result) -> list[str]:
    steps = result.stages.staged
    if isinstance(steps, NoSteps):
        if result.observations.total == 0:
            return ["The four steps need legs in sight: there is no staged.yaml."]
        return [f"The four steps alone gave no result, and no staged.yaml: {steps.failure}"]
    left_out = (
        f" They left out or at nominal {len(steps.diagnostics)} axes, joints or directions."
        * bool(steps.diagnostics)
    )
    if steps.from_fit is None:
        return [f"The four steps alone gave a result.{left_out}"]
    return [
        f"The four steps alone end {1e3 * steps.from_fit.dX_m:.3f} mm / "
        f"{np.degrees(steps.from_fit.dE_rad):.3f} deg from the fit at the platform.{left_out}"
    ]


def _fit_line(result: Result) -> str:
    found = result.residuals
    parts = [f"{found.dof} degrees of freedom"]
    if found.rms_px is not None:
        parts.append(f"{found.rms_px:.3f} px rms")
    if found.redundant_readings is not None:
        parts.append(f"readings of redundant motors {residuals_in_words(found.redundant_readings)}")
    line = (
        f"The joint fit started from the {result.start} model: chi2 {found.chi2:.1f} "
        f"for {', '.join(parts)}."
    )
    shared = [f"{what} {sigma:.3f} px" for what, sigma in found.shared_px.items() if sigma > _NONE]
    return line + (f" Common-mode edge biases: {', '.join(shared)}." if shared else "")


def residuals_in_words(found: ReadingResiduals) -> str:
    """Return how far readings of redundant motors are off."""
    return (
        f"off by {1e3 * found.rms_m:.4f} mm, {found.rms:.2f} of their standard deviations, rms "
        f"(expected {found.rms_expected:.2f})"
    )


def _direction_lines(result: Result, n_worst: int | None = None) -> list[str]:
    """Return which combinations of parameters are least certain, and which are held."""
    weakest = result.weakest[:n_worst]
    worst = [f"{weak.in_words} ({1e3 * weak.sigma_m:.3f} mm)" for weak in weakest]
    least = (
        f"Least certain combination{'s' * (len(worst) > 1)} (1 sigma, in the links): "
        f"{'; '.join(worst)}."
    )
    lines = [least] if worst else []
    if result.held:
        lines.append(
            "Held at nominal, as nothing determines them and they do not move the platform: "
            f"{'; '.join(result.held)}."
        )
    return lines


def _platform_lines(found: PlatformBlock, *, verbose: bool) -> list[str]:
    """Return the predicted error of the platform, and what would add to it."""
    parts = [f"at the {found.poses} poses {_predicted(found)}"]
    if found.workspace is not None:
        parts.append(f"over the workspace {_predicted(found.workspace)}")
    return [
        f"Predicted error of the platform (1 sigma): {'; '.join(parts)}.",
        *(
            f"{one.what.capitalize()} would move the platform by {mm_deg(one.dX_m, one.dE_rad)}, "
            f"at most {mm_deg(one.dX_max_m, one.dE_max_rad)}."
            for one in found.sensitivities
            if verbose or 1e3 * one.dX_max_m > _NONE or np.degrees(one.dE_max_rad) > 0.1 * _NONE
        ),
    ]


def _predicted(at: PlatformBlock | WorkspaceAccuracy) -> str:
    mean, most = (at.sigma_dX_m, at.sigma_dE_rad), (at.sigma_dX_max_m, at.sigma_dE_max_rad)
    return f"{mm_deg(*mean)}, at most {mm_deg(*most)}"


def _holdout_lines(found: Holdout) -> list[str]:
    of = f"{found.images} image{'s' * (found.images != 1)} kept aside"
    if found.rms_px is None or found.expected_px is None:
        return [f"Held out: {of} show no outline that could be compared."]
    views = ", ".join(f"{name} {rms:.3f}" for name, rms in found.views.items())
    return [
        f"Held out: {of}: {found.outlines - found.wrong} of {found.outlines} outlines are "
        f"{found.rms_px:.3f} px (rms) from their prediction by the others, "
        f"{found.expected_px:.3f} px were expected ({views})."
    ]


# Charts


def parameter_charts(quantities: Sequence[Quantity]) -> list[Canvas]:
    """Draw changes and standard deviations of estimated quantities, a chart for each unit."""
    charts = []
    for unit in ("mm", "deg"):
        shown = [q for q in quantities if q.unit == unit and q.sigma]
        if shown:
            changes = [None if q.change is None else abs(q.change) for q in shown]
            bars = Bars("change", changes), Bars("1 sigma", [q.sigma for q in shown])
            names = [q.name for q in shown]
            charts.append(log_bars("Change against the nominal model", unit, names, *bars))
    return charts


def platform_chart(result: Result) -> list[Canvas]:
    """Draw the change of the platform at the poses, and its predicted error; none without both."""
    poses = [] if result.platform is None else result.platform.per_pose
    number = np.arange(1.0, len(poses) + 1.0)
    lines = [
        Points(number, 1e3 * np.array(values), group=k, label=label, line="")
        for k, (values, label) in enumerate(
            (
                ([pose.change_dX_m for pose in poses], "before: change against the nominal model"),
                ([pose.sigma_dX_m for pose in poses], "after: predicted error (1 sigma)"),
            )
        )
    ]
    return [scatter("Platform error", lines, "pose", "platform [mm]", log=True)] if poses else []
