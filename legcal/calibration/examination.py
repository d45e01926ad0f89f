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
    """Something that a reader should know before calibrating."""

    check: str  # one of CHECKS
    severity: Severity  # an error stands against calibrating, a warning makes the result worse
    what: str  # one sentence, with the remedy
    images: tuple[str, ...] = ()  # that it is about, if it is about some


class EncoderUse(Document):
    """What the readings of an encoder are."""

    column: str
    unit: Literal["m", "rad"]  # of what follows
    least: float
    greatest: float
    travel: tuple[float, float] | None  # None where the model has no limits
    used: float | None  # share of the travel


class ViewCondition(Document):
    """What the photographs of a view are like, and what they show.

    Legs are counted in each image that should show them: neither outside nor hidden. They are found
    where one of their outlines is used. Nothing is known of outlines where none were searched.
    """

    view: str
    images: int
    camera: str  # the file
    blur_px: float | None  # usual one of sharp edges; None where nothing can be seen
    clipped: float | None  # usual share of pixels that are as bright as a file can say
    jpeg_quality: int | None  # the least; None where nothing is lost
    legs_found: int | None = None  # in all images together
    legs_visible: int | None = None
    outlines: int | None = None
    outlines_used: int | None = None
    edited: int | None = None
    contrast: float | None = None  # median of the used outlines, as the next ones [grey levels]
    length: float | None = None  # [px]
    residual: float | None = None  # [px]
    rejected: dict[str, int] = Field(default_factory=dict)  # by code of the reason, most first
    problem: str | None = None  # why its camera could not be placed


class CheckState(Document):
    """What one of the checks looked at, and the severity of its worst finding."""

    name: str
    state: Severity | Literal["ok"]
    found: str


class ExaminationDocument(Document):
    """What ``legcal doctor --json`` and ``legcal detect --json`` print."""

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
    overlays: list[Overlay]  # files relative to the folder that was written
    diagnosis: list[DiagnosisBlock]


@brief
@dataclass(frozen=True, eq=False)
class Examination:
    """The result of :func:`legcal.doctor`.

    Attributes
    ----------
    dataset, mechanism : str
        What was looked at.
    checks : tuple of CheckState
        What each check looked at; those that could not be made are not there.
    findings : tuple of Finding
        The most severe first.
    encoders : tuple of EncoderUse
        Readings against travel.
    views : tuple of ViewCondition
        The photographs of each view.
    diagnosis : tuple of Diagnosis
        What explains images that contradict the session, the likeliest first.
    is_usable : bool
        Whether all files can be used.
    detection : Detection or None
        The outlines of the legs in the images; None where these could not be searched.
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
        """Return how many findings are of a severity."""
        return sum(one.severity == severity for one in self.findings)

    @property
    def n_used(self) -> int:
        """How many outlines can be used."""
        return sum(view.outlines_used or 0 for view in self.views)

    @property
    def is_ready(self) -> bool:
        """Whether nothing stands against calibrating."""
        return not self.count("error")

    @property
    def sentence(self) -> str:
        """Whether to go on, and with what."""
        wrong, odd = self.count("error"), self.count("warning")
        look = f", {odd} thing{'s' * (odd != 1)} to look at" * (odd > 0)
        if wrong:
            return f"{wrong} thing{'s' * (wrong != 1)} to mend before calibrating{look}."
        folder = shlex.quote(printable(self.dataset))
        return f"Nothing stands against calibrating{look}: legcal calibrate {folder} -o OUT"

    def document(self) -> dict[str, Any]:
        """Return what ``legcal doctor --json`` prints."""
        seen, overlays, left_out = self.detection, list[Overlay](), list[LeftOut]()
        if seen is not None:
            m = seen.dataset.measurements
            names, left_out = row_names(m), left_out_blocks(m, seen.left_out)
            files = seen.overlay_files if self.is_written else {}
            overlays = [
                Overlay(view=seen.view_of(row), image=names[row], file=file)
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
            diagnosis=[one.document() for one in self.diagnosis],
        ).document()
