"""What a reader of a result should know, with what it is about."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum


class Topic(StrEnum):
    """What a note is about, as its heading has it."""

    DIAGNOSIS = "Diagnosis"
    DATASET = "Dataset"
    CAMERAS = "Cameras"
    BOARDS = "Calibration boards"
    IMAGES = "Images and outlines"
    READINGS = "Readings"
    MODEL = "Model"
    FIT = "Fit"


class Note(str):
    """A sentence with its topic; one without is about the fit."""

    topic: Topic = Topic.FIT

    @classmethod
    def about(cls, topic: Topic, sentences: Iterable[str]) -> list[Note]:
        """Return sentences as notes on a topic; notes keep theirs."""
        found = []
        for sentence in sentences:
            note = cls(sentence)
            note.topic = topic_of(sentence, topic)
            found.append(note)
        return found


def topic_of(note: str, otherwise: Topic = Topic.FIT) -> Topic:
    """Return what a note is about."""
    return note.topic if isinstance(note, Note) else otherwise
