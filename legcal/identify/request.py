"""What ``legcal identify`` was asked: a model with views, or a dataset."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from legcal.errors import UsageError
from legcal.identify.analysis import identifiability, identifiability_of_dataset
from legcal.identify.identifiability import Identifiability
from legcal.mechanism.files import DATASET_YAML
from legcal.mechanism.load import load_mechanism

_IMAGES = 15


def answer(
    source: str,
    views: Sequence[Sequence[str]],
    images: int | None,
    *,
    board: bool = False,
    hand_held: bool = False,
) -> Identifiability:
    """Return the report on a model with views, or on a dataset.

    Parameters
    ----------
    source : str
        A mechanism as :func:`legcal.mechanism.load.load_mechanism` takes it, or a dataset folder or
        its ``dataset.yaml``.
    views : sequence of sequences of str
        Legs of each view; none for a dataset.
    images : int or None
        Images a view; None for 15, and for a dataset.
    board, hand_held : bool
        Whether there is a calibration board, and whether every image has a place of its own.

    Raises
    ------
    UsageError
        If any of these is given for a dataset, or does not fit the model.
    """
    path = Path(source)
    if not (path.name == DATASET_YAML or (path / DATASET_YAML).is_file()):
        return identifiability(
            load_mechanism(source),
            views,
            _IMAGES if images is None else images,
            board=board,
            hand_held=hand_held,
        )
    given = {
        "--view": bool(views),
        "--images": images is not None,
        "--board": board,
        "--hand-held": hand_held,
    }
    for option in (name for name, is_given in given.items() if is_given):
        raise UsageError(
            f"{source}: the dataset could not be judged with {option}: found a dataset, which has "
            f"its own views and images, needed a model for that; leave {option} out, or name the "
            "model."
        )
    from legcal.dataset.folder import load_dataset

    return identifiability_of_dataset(load_dataset(path, check_images=False))
