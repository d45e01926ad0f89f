"""The result of ``legcal doctor`` and ``legcal detect``: figures, and findings with remedies."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from typing import Any, Literal

from pydantic import Field

from legcal.brief import brief
from legcal.calibration.detection import Detection
from legcal.calibration.diagnosis.diagnosis import Diagnosis
from legcal.calibration.documents import DiagnosisBlock, LeftOut, Overlay, left_out_blocks
from legcal.data.measurements import row_names
from legcal.errors import printable
from legcal.files.schema import Document

Severity = Literal["error", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "note")
CHECKS = ("files", "readings", "camera", "photographs", "legs", "parameters", "mistakes")


class Finding(Document):
    """A problem or remark about the dataset."""

    check: str  # one of CHECKS
    severity: Severity  # an error prevents calibration, a warning makes the result worse
    what: str  # one sentence, with the remedy
    images: tuple[str, ...] = ()  # affected images


class EncoderUse(Document):
    """The range of the readings of an encoder."""

    column: str
    unit: Literal["m", "rad"]  # unit of the following values
    least: float
    greatest: float
    travel: tuple[float, float] | None  # None if the model has no limits
    used: float | None  # share of the travel


class ViewCondition(Document):
    """Condition of the photographs of a view, and the outlines in them.

    Legs are counted in each image in which they are visible: neither outside nor hidden. A leg is
    found if one of its outlines is used. Fields of outlines are None if none were searched.
    """

    view: str
    images: int
    camera: str  # camera file
    blur_px: float | None  # median blur of sharp edges; None without any
    clipped: float | None  # median share of saturated pixels
    jpeg_quality: int | None  # lowest quality; None for lossless files
    legs_found: int | None = None  # number in all images
    legs_visible: int | None = None
    outlines: int | None = None
    outlines_used: int | None = None
    edited: int | None = None
    contrast: float | None = None  # median of the used outlines [grey levels]
    length: float | None = None  # median of the used outlines [px]
    residual: float | None = None  # median of the used outlines [px]
    rejected: dict[str, int] = Field(default_factory=dict)  # by code of the reason, most first
    problem: str | None = None  # reason why the camera could not be placed


class CheckState(Document):
    """Summary of a check and the severity of its worst finding."""

    name: str
    state: Severity | Literal["ok"]
    found: str


class ExaminationDocument(Document):
    """The output of ``legcal doctor --json`` and ``legcal detect --json``."""

    legcal_doctor: int
    dataset: str
    mechanism: str
    ready: bool
    usable: bool
    checks: list[CheckState]
    findings: list[Finding]
    encoders: list[EncoderUse]
    views: list[ViewCondition]
    images: int
    outlines: int
    used: int
    left_out: list[LeftOut]
    overlays: list[Overlay]  # files relative to the output folder
    diagnosis: list[DiagnosisBlock]


@brief
@dataclass(frozen=True, eq=False)
class Examination:
    """The result of :func:`legcal.doctor`.

    Attributes
    ----------
    dataset, mechanism : str
        Folder of the dataset and name of the machine.
    checks : tuple of CheckState
        Summaries of the checks that could be made.
    findings : tuple of Finding
        Findings, the most severe first.
    encoders : tuple of EncoderUse
        Range of the readings of each encoder.
    views : tuple of ViewCondition
        Condition of the photographs of each view.
    diagnosis : tuple of Diagnosis
        Mistakes that explain contradicting images, the likeliest first.
    is_usable : bool
        Whether all files can be used.
    detection : Detection or None
        The outlines of the legs in the images; None if the images could not be searched.
    is_written : bool
        Whether the outlines were written with pictures and a page.
    """

    dataset: str
    mechanism: str
    checks: tuple[CheckState, ...]
    findings: tuple[Finding, ...]
    encoders: tuple[EncoderUse, ...]
    views: tuple[ViewCondition, ...]
    diagnosis: tuple[Diagnosis, ...]
    is_usable: bool
    detection: Detection | None = None
    is_written: bool = False

    def count(self, severity: Severity) -> int:
        """Return the number of findings of a severity."""
        return sum(finding.severity == severity for finding in self.findings)

    @property
    def n_used(self) -> int:
        """Number of usable outlines."""
        return sum(view.outlines_used or 0 for view in self.views)

    @property
    def is_ready(self) -> bool:
        """Whether there are no errors."""
        return not self.count("error")

    @property
    def sentence(self) -> str:
        """The verdict with the next command."""
        n_errors, n_warnings = self.count("error"), self.count("warning")
        warnings = f", {n_warnings} warning{'s' * (n_warnings != 1)}" * (n_warnings > 0)
        if n_errors:
            return f"{n_errors} error{'s' * (n_errors != 1)} to fix before calibrating{warnings}."
        folder = shlex.quote(printable(self.dataset))
        return f"Ready to calibrate{warnings}: legcal calibrate {folder} -o OUT"

    def document(self) -> dict[str, Any]:
        """Return the output of ``legcal doctor --json``."""
        detection, overlays, left_out = self.detection, list[Overlay](), list[LeftOut]()
        if detection is not None:
            m = detection.dataset.measurements
            names, left_out = row_names(m), left_out_blocks(m, detection.left_out)
            files = detection.overlay_files if self.is_written else {}
            overlays = [
                Overlay(view=detection.view_of(row), image=names[row], file=file)
                for row, file in files.items()
            ]
        return ExaminationDocument(
            legcal_doctor=1,
            dataset=self.dataset,
            mechanism=self.mechanism,
            ready=self.is_ready,
            usable=self.is_usable,
            checks=list(self.checks),
            findings=list(self.findings),
            encoders=list(self.encoders),
            views=list(self.views),
            images=sum(view.images for view in self.views),
            outlines=sum(view.outlines or 0 for view in self.views),
            used=self.n_used,
            left_out=left_out,
            overlays=overlays,
            diagnosis=[diagnosis.document() for diagnosis in self.diagnosis],
        ).document()
