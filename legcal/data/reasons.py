"""Reasons for not using an outline, a corner or an image: a code, and a detail for the reader.

Programs compare codes (:class:`Reason`); tables store code and detail in two columns; sentences are
made where people read them. Tables of earlier versions hold sentences, which are read as well.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np

from legcal.causes import Cause
from legcal.geometry.types import BoolArray


class Reason(StrEnum):
    """A reason for not using an outline, a corner or an image."""

    NONE = ""
    # Out of sight of the camera
    OUTSIDE = "outside"
    HIDDEN = "hidden"
    NARROW = "narrow"
    SHORT = "short"
    NOT_PLACED = "not_placed"
    UNUSED_LEG = "unused_leg"
    # Not measured well enough
    NO_PAIR = "no_pair"
    NO_EDGE = "no_edge"
    FAINT = "faint"
    OVEREXPOSED = "overexposed"
    NOT_STRAIGHT = "not_straight"
    CONTRAST = "contrast"
    ROUGH = "rough"
    UNCERTAIN = "uncertain"
    WIDTH = "width"
    PARTNER = "partner"
    # Contradicting other measurements
    VIEW_DISAGREES = "view_disagrees"
    DISAGREES = "disagrees"
    ARM_LEFT_OUT = "arm_left_out"
    FEW_LEGS = "few_legs"
    NO_BOARD_POSE = "no_board_pose"
    CORNER_OFF = "corner_off"
    NOT_BEFORE = "not_before"
    LITTLE_GAIN = "little_gain"
    # Problems of a whole image
    BLACK = "black"
    OVEREXPOSED_IMAGE = "overexposed_image"
    EMPTY = "empty"
    BLURRED = "blurred"
    MIRRORED = "mirrored"
    UPSIDE_DOWN = "upside_down"
    ZOOMED = "zoomed"
    OTHER_READING = "other_reading"
    OTHER_VIEW = "other_view"
    OTHER_SCENE = "other_scene"
    # Decisions of people
    BY_HAND = "by_hand"
    OTHER = "other"


# In words: without a detail, and with a detail.
WORDS_BY_CODE: dict[str, tuple[str, str]] = {
    Reason.NONE: ("", ""),
    Reason.OUTSIDE: ("outside the image", ""),
    Reason.HIDDEN: ("hidden by another part", "hidden by {}"),
    Reason.NARROW: ("too narrow", "too narrow, {} px wide"),
    Reason.SHORT: ("too short", "too short, {}"),
    Reason.NOT_PLACED: ("the camera of its view could not be placed", ""),
    Reason.UNUSED_LEG: ("its view does not use this leg", "view {} does not use this leg"),
    Reason.NO_PAIR: ("no convincing pair of edges", ""),
    Reason.NO_EDGE: ("no convincing edge", ""),
    Reason.FAINT: ("edge barely visible", "edge barely visible, detected on {} % of it"),
    Reason.OVEREXPOSED: (
        "the background is overexposed",
        "the background is overexposed, {} px of the step are left",
    ),
    Reason.NOT_STRAIGHT: ("edge not straight", "edge not straight, {} % of it on one line"),
    Reason.CONTRAST: ("low contrast", "low contrast, {} grey levels"),
    Reason.ROUGH: ("edge too rough", "edge too rough, scatter {} px"),
    Reason.UNCERTAIN: ("edge too uncertain", "edge too uncertain, sigma {} px"),
    Reason.WIDTH: (
        "width inconsistent with the radius",
        "width inconsistent with the radius, {}",
    ),
    Reason.PARTNER: ("partner outline rejected", "its other outline: {}"),
    Reason.VIEW_DISAGREES: ("disagrees with the other legs of its view", ""),
    Reason.DISAGREES: ("disagrees with the fit", "disagrees with the fit by {}"),
    Reason.ARM_LEFT_OUT: ("the arm is left out as a whole", ""),
    Reason.FEW_LEGS: (
        "shows too few legs to place the platform",
        "shows too few legs to place the platform, {}",
    ),
    Reason.NO_BOARD_POSE: ("no pose of the board explains it", ""),
    Reason.CORNER_OFF: (
        "far from where the other corners put it",
        "{} px from where the other corners put it",
    ),
    Reason.NOT_BEFORE: ("not used in the previous measurement", ""),
    Reason.LITTLE_GAIN: (
        "edges of bodies add too little to what the rods tell",
        "edges of bodies lower the predicted error of the platform by {} only",
    ),
    Reason.BLACK: ("the image is black", "the image is black, at most {} of 255 grey levels"),
    Reason.OVEREXPOSED_IMAGE: (
        "the image is overexposed",
        "the image is overexposed, at least {} of 255 grey levels",
    ),
    Reason.EMPTY: (
        "the image shows nothing",
        "the image shows nothing, all of it within {} of 255 grey levels",
    ),
    Reason.BLURRED: ("the image is blurred", "the image is blurred by {}"),
    Reason.MIRRORED: ("the image is mirrored", ""),
    Reason.UPSIDE_DOWN: ("the image is upside down", ""),
    Reason.ZOOMED: (
        "it shows the legs in another size: zoomed, or cropped and rescaled",
        "it shows the legs about {} times as large as the others: zoomed, or cropped and rescaled",
    ),
    Reason.OTHER_READING: ("it shows another reading", "{}"),
    Reason.OTHER_VIEW: ("it was taken by another camera", "{}"),
    Reason.OTHER_SCENE: ("its legs are not where its readings predict them", ""),
    Reason.BY_HAND: ("rejected by hand", ""),
    Reason.OTHER: ("no reason given", "{}"),
}
_PARTNER = "its other outline: "
# Sentences of earlier versions with other words
_EARLIER_WORDS = {
    "edge hardly visible, found on {} % of it": Reason.FAINT,
    "edge hardly visible": Reason.FAINT,
    "other outline fails": Reason.PARTNER,
    "not used before": Reason.NOT_BEFORE,
    "it shows the legs about {} times as large as the others: zoom, or a crop scaled": (
        Reason.ZOOMED
    ),
    "it shows the legs in another size: zoom, or a crop scaled": Reason.ZOOMED,
    "it does not show the legs where its reading has them": Reason.OTHER_SCENE,
}


@dataclass(frozen=True, slots=True)
class Rejection:
    """The reason why an observation is not used; false for a used one."""

    reason: Reason = Reason.NONE
    detail: str | Cause = ""  # a name or figures for the reader; of PARTNER the code of the other

    def __bool__(self) -> bool:
        return self.reason is not Reason.NONE

    @property
    def summary(self) -> str:
        """The reason in words, without figures and names."""
        return WORDS_BY_CODE[self.reason][0]

    @property
    def cause(self) -> Cause:
        """The reason in words, with figures and names."""
        plain, detailed = WORDS_BY_CODE[self.reason]
        if not self.detail or not detailed:
            return Cause(plain)
        if self.reason is Reason.PARTNER:
            return Cause(detailed, (read_rejection(str(self.detail), "").cause,))
        return Cause(detailed, (self.detail,))

    @property
    def as_stored(self) -> Rejection:
        """The same rejection with its detail in words, as stored in tables."""
        return replace(self, detail=str(self.detail))

    def __str__(self) -> str:
        return str(self.cause)


USED = Rejection()  # not rejected


def have_reason(rejections: Sequence[Rejection], *reasons: Reason) -> BoolArray:
    """Return a mask (n,) of the rejections for any of some reasons."""
    return np.array([rejection.reason in reasons for rejection in rejections], dtype=np.bool_)


def reason_in_words(code: str) -> str:
    """Return a code of a document (``result.json``) in words, without figures and names."""
    return read_rejection(code, "").summary


_CODES = frozenset(map(str, Reason))
_WORDS = [
    (forms[k], Reason(code))
    for k in (1, 0)  # first the sentences with a detail
    for code, forms in WORDS_BY_CODE.items()
]
_SENTENCES = [  # patterns of tables with sentences in place of codes
    (re.compile(re.escape(words).replace(r"\{\}", "(.+)")), reason)
    for words, reason in (*_WORDS, *_EARLIER_WORDS.items())
    if words not in ("", "{}")
]


def read_rejection(code: str, detail: str) -> Rejection:
    """Return the rejection of the columns ``reason`` and ``detail`` of a table.

    A sentence in place of a code, as earlier versions wrote, is recognised; any other text is a
    remark of a person (``OTHER``).
    """
    if code in _CODES:
        return Rejection(Reason(code), detail)
    if code.startswith(_PARTNER):
        partner = read_rejection(code.removeprefix(_PARTNER), "")
        return Rejection(Reason.PARTNER, str(partner.reason))
    for pattern, reason in _SENTENCES:
        if match := pattern.fullmatch(code):
            return Rejection(reason, match[1] if match.groups() else "")
    return Rejection(Reason.OTHER, code)
