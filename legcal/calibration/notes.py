"""Notes on a result, with their topics."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum


class Topic(StrEnum):
    """The topic of a note, as in its heading."""

    DIAGNOSIS = "Diagnosis"
    DATASET = "Dataset"
    CAMERAS = "Cameras"
    BOARDS = "Calibration boards"
    IMAGES = "Images and outlines"
    READINGS = "Readings"
    MODEL = "Model"
    FIT = "Fit"


class Note(str):
    """A sentence with a topic; the default topic is the fit."""

    topic: Topic = Topic.FIT

    @classmethod
    def about(cls, topic: Topic, sentences: Iterable[str]) -> list[Note]:
        """Return sentences as notes on a topic; notes keep their own topic."""
        notes = []
        for sentence in sentences:
            note = cls(sentence)
            note.topic = topic_of(sentence, topic)
            notes.append(note)
        return notes


def topic_of(note: str, otherwise: Topic = Topic.FIT) -> Topic:
    """Return the topic of a note, or *otherwise* for a plain sentence."""
    return note.topic if isinstance(note, Note) else otherwise
