"""Reading a mechanism of any format: which one it is, and the reader of that format."""

from pathlib import Path

from legcal.mechanism.files import find_urdf, find_yaml
from legcal.mechanism.schema import read_mechanism_file
from legcal.mechanism.sources.source import Source
from legcal.mechanism.urdf import read_urdf


def read_source(model: str | Path) -> Source:
    """Return the tree and the closures of a mechanism, checked in themselves.

    Parameters
    ----------
    model : str or Path
        A mechanism YAML, a URDF with its YAML beside it (or in ``../models``), or the name of
        a shipped model.

    Raises
    ------
    ModelError
        If a file is missing or malformed; all problems of a file at once.
    OutOfClass
        If nothing closes the loops.
    """
    path = find_yaml(model)
    file = read_mechanism_file(path)
    return Source(path, file, read_urdf(find_urdf(path, file.legcal.urdf)))
