"""Paths that a dataset names: relative, and inside its folder."""

from pathlib import Path, PurePosixPath, PureWindowsPath


def path_problem(folder: Path, named: str) -> str | None:
    """Return what keeps a path from being a relative path inside a folder, or None.

    Symbolic links are followed: a link that leads out of the folder is a way out of it.

    Parameters
    ----------
    folder : Path
        The dataset folder.
    named : str
        The path as the file names it.
    """
    if PurePosixPath(named).is_absolute() or PureWindowsPath(named).is_absolute():
        return "an absolute path"
    try:
        target = (folder / named).resolve()
    except (OSError, RuntimeError, ValueError):
        return "a path that cannot be followed"
    if not target.is_relative_to(folder.resolve()):
        return "a path that leads out of the dataset folder"
    return None
