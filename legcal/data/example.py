"""The dataset that comes with legcal: a simulated hexapod with 45 photographs."""

import shutil
from pathlib import Path

from legcal.errors import OutOfResources, UsageError
from legcal.files.folder import OutputKind, check_path, holds_files, result_folder
from legcal.machine.files import DATASET_YAML, shipped_folder

EXAMPLE = "examples/hexapod"
KIND = OutputKind("example", "", "legcal_dataset")
_OWN = ("dataset.yaml", "measurements.csv", "camera_info.yaml", "images", "models", "urdf")


def copy_example(destination: Path) -> None:
    """Copy the example dataset into a new or empty folder, complete or not at all.

    Raises
    ------
    UsageError
        If the folder holds files.
    OutOfResources
        If it does not take the files, or legcal was installed without them.
    """
    check_path(destination, KIND)
    if destination.is_dir() and holds_files(destination):
        raise UsageError(
            f"{destination}: the example could not be written: found a folder with files, needed "
            "a new or empty one; give another folder with -o."
        )
    source = shipped_folder(EXAMPLE)
    if not (source / DATASET_YAML).is_file():
        raise OutOfResources(
            f"{source}: the example could not be read: found no {DATASET_YAML}, needed the files "
            "that come with legcal; install it again."
        )
    with result_folder(destination, KIND) as folder:
        for name in _OWN:  # without results of a calibration beside them
            if (source / name).is_dir():
                shutil.copytree(source / name, folder / name)
            else:
                shutil.copyfile(source / name, folder / name)
