"""Reasons for not using an outline, a corner or an image: a code, and a detail for the reader.

Programs compare codes (:class:`Reason`); tables store code and detail in two columns; sentences are
made where people read them. Tables of earlier versions hold sentences, which are read as well.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from enum import StrEnum

from legcal.errors import Cause


class Reason(StrEnum):
    """A reason for not using an outline, a corner or an image, by its code."""

    words: str
    words_of_detail: str  # with a place for the detail; "" if none is shown

    def __new__(cls, code: str, words: str = "", words_of_detail: str = "") -> Reason:
        """Return a row of the table."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.words, member.words_of_detail = words, words_of_detail
        return member

    NONE = "", ""
    # Out of sight of the camera
    OUTSIDE = "outside", "outside the image"
    HIDDEN = "hidden", "hidden by another part", "hidden by {}"
    NARROW = "narrow", "too narrow", "too narrow, {} px wide"
    SHORT = "short", "too short", "too short, {}"
    NOT_PLACED = "not_placed", "the camera of its view could not be placed"
    UNUSED_LEG = "unused_leg", "its view does not use this leg", "view {} does not use this leg"
    # Not measured well enough
    NO_PAIR = "no_pair", "no convincing pair of edges"
    NO_EDGE = "no_edge", "no convincing edge"
    FAINT = "faint", "edge barely visible", "edge barely visible, detected on {} % of it"
    OVEREXPOSED = (
        "overexposed",
        "the background is overexposed",
        "the background is overexposed, {} px of the step are left",
    )
    NOT_STRAIGHT = "not_straight", "edge not straight", "edge not straight, {} % of it on one line"
    CONTRAST = "contrast", "low contrast", "low contrast, {} grey levels"
    ROUGH = "rough", "edge too rough", "edge too rough, scatter {} px"
    UNCERTAIN = "uncertain", "edge too uncertain", "edge too uncertain, sigma {} px"
    WIDTH = (
        "width",
        "width inconsistent with the radius",
        "width inconsistent with the radius, {}",
    )
    PARTNER = "partner", "partner outline rejected", "its other outline: {}"
    # Contradicting other measurements
    VIEW_DISAGREES = "view_disagrees", "disagrees with the other legs of its view"
    DISAGREES = "disagrees", "disagrees with the fit", "disagrees with the fit by {}"
    ARM_LEFT_OUT = "arm_left_out", "the arm is left out as a whole"
    FEW_LEGS = (
        "few_legs",
        "shows too few legs to place the platform",
        "shows too few legs to place the platform, {}",
    )
    NO_BOARD_POSE = (
        "no_board_pose",
        "no pose of the board explains it",
        "no pose of the board explains it, found {}",
    )
    CORNER_OFF = (
        "corner_off",
        "far from where the other corners put it",
        "{} px from where the other corners put it",
    )
    NOT_BEFORE = "not_before", "not used in the previous measurement"
    LITTLE_GAIN = (
        "little_gain",
        "edges of bodies add too little to what the rods tell",
        "edges of bodies lower the predicted error of the platform by {} only",
    )
    # Problems of a whole image
    BLACK = "black", "the image is black", "the image is black, at most {} of 255 grey levels"
    OVEREXPOSED_IMAGE = (
        "overexposed_image",
        "the image is overexposed",
        "the image is overexposed, at least {} of 255 grey levels",
    )
    EMPTY = (
        "empty",
        "the image shows nothing",
        "the image shows nothing, all of it within {} of 255 grey levels",
    )
    BLURRED = "blurred", "the image is blurred", "the image is blurred by {}"
    MIRRORED = "mirrored", "the image is mirrored"
    UPSIDE_DOWN = "upside_down", "the image is upside down"
    ZOOMED = (
        "zoomed",
        "it shows the legs in another size: zoomed, or cropped and rescaled",
        "it shows the legs about {} times as large as the others: zoomed, or cropped and rescaled",
    )
    OTHER_READING = "other_reading", "it shows another reading", "{}"
    OTHER_VIEW = "other_view", "it was taken by another camera", "{}"
    OTHER_SCENE = "other_scene", "its legs are not where its readings predict them"
    # Decisions of people
    BY_HAND = "by_hand", "rejected by hand"
    OTHER = "other", "no reason given", "{}"


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
    def cause(self) -> Cause:
        """The reason in words, with figures and names."""
        words = self.reason.words_of_detail
        if not self.detail or not words:
            return Cause(self.reason.words)
        if self.reason is Reason.PARTNER:
            return Cause(words, (read_rejection(str(self.detail), "").cause,))
        return Cause(words, (self.detail,))

    @property
    def as_stored(self) -> Rejection:
        """The same rejection with its detail in words, as stored in tables."""
        return replace(self, detail=str(self.detail))

    def __str__(self) -> str:
        return str(self.cause)


USED = Rejection()  # not rejected


def reason_in_words(code: str) -> str:
    """Return a code of a document (``result.json``) in words, without figures and names."""
    return read_rejection(code, "").reason.words


_CODES = frozenset(map(str, Reason))
_SENTENCES = [  # patterns of tables with sentences in place of codes, those with a detail first
    (re.compile(re.escape(words).replace(r"\{\}", "(.+)")), reason)
    for words, reason in (
        *((reason.words_of_detail, reason) for reason in Reason),
        *((reason.words, reason) for reason in Reason),
        *_EARLIER_WORDS.items(),
    )
    if words not in ("", "{}")
]


def read_rejection(code: str, detail: str) -> Rejection:
    """Return the rejection of the columns ``reason`` and ``detail`` of a table.

    A sentence in place of a code, as earlier versions wrote, is recognised; any other text is a
    remark of a person (``OTHER``).
    """
    if code in _CODES:
        return Rejection(Reason(code), detail)
    for pattern, reason in _SENTENCES:
        if match := pattern.fullmatch(code):
            detail = match[1] if match.groups() else ""
            if detail and reason is Reason.PARTNER:
                detail = str(read_rejection(detail, "").reason)
            return Rejection(reason, detail)
    return Rejection(Reason.OTHER, code)
