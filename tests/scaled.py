"""The same photographs of a machine of another size: all lengths of a dataset times a factor."""

import shutil
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
from edits import document, each_row


def scaled_dataset(source: Path, folder: Path, factor: float) -> Path:
    """Copy a dataset with its lengths times a factor: model, readings, sigmas, rough cameras.

    Photographs are of directions alone: those of the larger machine from farther away are the same.
    Readings of a motor that turns stay, and all lengths must be written in metres.
    """
    kept = [".legcal-cache.json", "observations.csv"]  # of an earlier detection
    left = kept if (source / kept[0]).exists() else []
    shutil.copytree(source, folder, ignore=shutil.ignore_patterns("truth", *left))
    prismatic = set[str]()
    for urdf in folder.rglob("*.urdf"):
        prismatic |= _scale_urdf(urdf, factor)

    def model(content: dict[str, Any]) -> None:
        _scale_pose(content["legcal"].get("home"), factor)
        for joint in prismatic.intersection(content["legcal"].get("home_readings", {})):
            content["legcal"]["home_readings"][joint] *= factor

    def dataset(content: dict[str, Any]) -> None:
        sigma = content["encoder_sigma"]
        content["encoder_sigma"] = (
            {name: x * (factor if name in prismatic else 1.0) for name, x in sigma.items()}
            if isinstance(sigma, dict)
            else factor * sigma
        )
        for view in content["views"].values():
            _scale_pose(view.get("T_base_camera"), factor)

    def readings(row: dict[str, str]) -> None:
        for name in prismatic.intersection(row):
            row[name] = repr(factor * float(row[name])) if row[name] else ""

    for path in folder.glob("models/*.yaml"):
        document(f"models/{path.name}", model)(folder)
    document("dataset.yaml", dataset)(folder)
    each_row("measurements.csv", readings)(folder)
    return folder


def _scale_urdf(path: Path, factor: float) -> set[str]:
    """Scale a URDF in place; return the names of its prismatic joints."""
    tree = ET.parse(path)
    for element in tree.iter():
        lengths = {"origin": ("xyz",), "cylinder": ("radius", "length"), "sphere": ("radius",),
                   "box": ("size",), "mesh": ("scale",)}.get(element.tag, ())  # fmt: skip
        for name in lengths:
            if name in element.attrib:
                element.set(name, _times(element.attrib[name], factor))
    joints = [one for one in tree.iter("joint") if one.get("type") == "prismatic"]
    for limit in (limit for joint in joints for limit in joint.iter("limit")):
        for name in ("lower", "upper"):
            limit.set(name, _times(limit.attrib[name], factor))
    tree.write(path)
    return {joint.attrib["name"] for joint in joints}


def _times(numbers: str, factor: float) -> str:
    return " ".join(repr(factor * float(number)) for number in numbers.split())


def _scale_pose(pose: dict[str, list[float]] | None, factor: float) -> None:
    if pose is not None:
        pose["xyz"] = (factor * np.array(pose["xyz"])).tolist()
