"""The same photographs of a machine of another size: all lengths of a dataset times a factor."""

import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import yaml
from csv_rows import read_rows, write_rows


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
    for model in folder.glob("models/*.yaml"):
        text = yaml.safe_load(model.read_text(encoding="utf-8"))
        _scale_pose(text["legcal"].get("home"), factor)
        for joint in prismatic.intersection(text["legcal"].get("home_readings", {})):
            text["legcal"]["home_readings"][joint] *= factor
        model.write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")
    path = folder / "dataset.yaml"
    text = yaml.safe_load(path.read_text(encoding="utf-8"))
    sigma = text["encoder_sigma"]
    if isinstance(sigma, dict):
        text["encoder_sigma"] = {
            joint: value * (factor if joint in prismatic else 1.0) for joint, value in sigma.items()
        }
    else:
        text["encoder_sigma"] = factor * sigma
    for view in text["views"].values():
        _scale_pose(view.get("T_base_camera"), factor)
    path.write_text(yaml.safe_dump(text, sort_keys=False), encoding="utf-8")
    _scale_readings(folder / text["measurements"], prismatic, factor)
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


def _scale_readings(path: Path, prismatic: set[str], factor: float) -> None:
    rows = read_rows(path)
    for row in rows:
        for name in prismatic.intersection(row):
            row[name] = repr(factor * float(row[name])) if row[name] else ""
    write_rows(path, rows)
