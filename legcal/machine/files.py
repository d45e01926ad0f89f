"""Finding and reading the files of a mechanism, from a path, a folder or a shipped name."""

import os
from pathlib import Path

from legcal.errors import Code, DatasetError, ModelError, Problem
from legcal.files.folder import RESULT
from legcal.files.schema import content_of

_PACKAGE = Path(__file__).resolve().parents[1]

FOLDER_YAML = "robot.yaml"  # mechanism YAML in a folder, as named by Gepetto
DATASET_YAML = "dataset.yaml"
RESULT_YAML = "calibrated.yaml"  # mechanism YAML in a result folder


def shipped_folder(name: str) -> Path:
    """Return a folder shipped with legcal, in a wheel or in a checkout."""
    folders = [top / name for top in (_PACKAGE / "shipped", _PACKAGE.parent)]
    return next((folder for folder in folders if folder.is_dir()), folders[0])


def shipped_names() -> list[str]:
    """Return the names of the shipped models."""
    return sorted(path.stem for path in shipped_folder("models").glob("*.yaml"))


def find_model(model: str | Path) -> Path:
    """Return the file of a mechanism, from a path or the name of a shipped model.

    A result folder gives its calibrated model.
    """
    path = Path(model)
    names = shipped_names()
    is_shipped = str(model) in names
    if os.path.isdir(path) and not is_shipped:
        if (path / FOLDER_YAML).is_file():
            return path / FOLDER_YAML
        if (path / RESULT_YAML).is_file():
            if RESULT.is_in(path):
                return path / RESULT_YAML
            raise ModelError(
                "the mechanism could not be read",
                f"{RESULT_YAML} and no whole {RESULT.marker} of a calibration",
                "both",
                f"copy the result folder again, or give {path / RESULT_YAML} if it is the "
                "model that you mean",
                path,
            )
        if (path / DATASET_YAML).is_file():
            raise ModelError(what_a_dataset_is_for(path))
        raise ModelError(
            "the mechanism could not be read",
            f"a folder without {FOLDER_YAML}",
            "a folder with it, a result folder, or a YAML, URDF or MJCF file",
            "give the file",
            path,
        )
    if os.path.exists(path) and not os.path.isdir(path):
        if path.suffix.lower() == ".csv":
            raise ModelError(
                "the mechanism could not be read: found a CSV file, needed a mechanism YAML, "
                f"URDF or MJCF file; if it is a table of legs: legcal new {path} -o DIR",
                file=path,
            )
        return path
    if is_shipped:
        return shipped_folder("models") / f"{model}.yaml"
    raise ModelError(
        Problem(
            "the mechanism could not be read",
            "no such file and no shipped model of that name",
            f"a mechanism YAML, its URDF, or one of {', '.join(names)}",
            "check the path",
            str(path),
            code=Code.MISSING_FILE,
        )
    )


def what_a_dataset_is_for(path: Path) -> Problem:
    """Return the problem of a dataset given as a model, with the commands for datasets."""
    folder = path.parent if path.name == DATASET_YAML else path
    return Problem(
        "the mechanism could not be read: found a dataset, needed a model; give the model that it "
        f"names, or judge the dataset with: legcal identify {folder}, and calibrate it with: "
        f"legcal calibrate {folder} -o OUT",
        file=str(path),
    )


def find_urdf(yaml_path: Path, written: str | None) -> Path:
    """Return the URDF of a mechanism YAML: the stated one, or the same stem nearby."""
    if written is not None:
        path = yaml_path.parent / written
        return path.resolve() if ".." in path.parts else path
    near = [yaml_path.with_suffix(".urdf"), _sibling(yaml_path, "urdf").with_suffix(".urdf")]
    for path in near:
        if path.is_file():
            return path
    raise ModelError(
        Problem(
            f"the URDF of the mechanism could not be found: looked for {near[0]} and "
            f"{near[1]}, needed one of them; write its path in legcal.urdf.",
            file=str(yaml_path),
            code=Code.MISSING_FILE,
        )
    )


def read_file(path: Path, kind: str) -> bytes:
    """Return the bytes of a mechanism file."""
    try:
        return content_of(path, kind)
    except DatasetError as error:
        raise ModelError(error.facts) from error


def is_xml(path: Path) -> bool:
    """Return whether a file of a mechanism is XML, by its content."""
    return read_file(path, "mechanism file").lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")


def yaml_of_urdf(path: Path) -> Path | None:
    """Return the mechanism YAML near a URDF, or None."""
    near = [path.with_suffix(".yaml"), _sibling(path, "models").with_suffix(".yaml")]
    return next((candidate for candidate in near if candidate.is_file()), None)


def _sibling(path: Path, folder: str) -> Path:
    """Return the path of a file of the same name in a sibling folder."""
    return path.resolve().parent.parent / folder / path.name
