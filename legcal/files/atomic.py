"""Files written complete or not at all."""

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

TEMPORARY_SUFFIX = ".legcal-part"
_MOST_OF_NAME = 40  # letters: a name of the greatest length leaves none for what is added to it


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file so that any other program sees its old or its new content, never a part.

    Parameters
    ----------
    path : Path
        The file; one that is there is replaced.
    content : bytes
        Its new content.

    Raises
    ------
    OSError
        If it cannot be written; the old file is then untouched.
    """
    with temporary_folder(path.parent, path.name) as folder:
        (folder / path.name).write_bytes(content)
        os.replace(folder / path.name, path)


@contextmanager
def temporary_folder(parent: Path, name: str) -> Iterator[Path]:
    """Give a folder of a name that nobody else uses, and remove it when the block ends."""
    folder = Path(
        tempfile.mkdtemp(prefix=f".{name[:_MOST_OF_NAME]}.", suffix=TEMPORARY_SUFFIX, dir=parent)
    )
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
