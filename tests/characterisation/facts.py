"""What of documents and folders is recorded: numbers, names and keys, no sentences."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import yaml

TEXT = "<text>"
SAID_SINCE = "known to no better than", "the file draws no closed pose"  # were not said then
DIGITS = 12  # of numbers that are not parameters

# Lists of many alike entries, of which their number and the keys of the first say enough.
ALIKE = {"per_pose", "overlays", "rows", "images", "explanations"}
SHAPES = {"held", "components"}  # what depends on the choice of a basis
MATRICES = {"covariance", "matrix"}
BUILDS = {"version", "legcal"}  # whatever made a file


def facts(document: Any, key: str = "", path: tuple[str, ...] = ()) -> Any:
    """Return what a correct program must give again."""
    if isinstance(document, dict):
        return _of_mapping(document, path)
    if isinstance(document, list | tuple):
        return _of_list(list(document), key, path)
    if isinstance(document, float):
        return float(f"{document:.{DIGITS}g}") if path[-2:-1] != ("parameters",) else document
    if isinstance(document, str):
        return TEXT if key in BUILDS or _is_sentence(document) else document
    return document


def _of_mapping(document: dict[Any, Any], path: tuple[str, ...]) -> Any:
    if any(_is_sentence(str(name)) for name in document):  # counts by reason
        return {TEXT: sorted(document.values())}
    found = {str(k): facts(v, str(k), (*path, str(k))) for k, v in document.items()}
    if "quat_xyzw" in found and isinstance(found["quat_xyzw"], list):
        found["quat_xyzw"] = _upright(found["quat_xyzw"])
    if isinstance(document.get("details"), list):  # were notes when the facts were recorded
        found["notes"] = {"sentences": len(document["notes"]) + len(document["details"])}
        del found["details"]
    if "weak" in document and "rank" in document:
        found["weak"] = _weak(document["weak"])
    return found


def _of_list(document: list[Any], key: str, path: tuple[str, ...]) -> Any:
    if key in SHAPES:
        return {"shape": list(np.shape(document))}
    if key in MATRICES and np.ndim(document) == 2:
        return _of_covariance(np.array(document, dtype=np.float64))
    if key in {"notes", "diagnostics", "warnings"}:
        return {
            "sentences": sum(not any(x in str(entry) for x in SAID_SINCE) for entry in document)
        }
    if document and all(isinstance(entry, str) and _is_sentence(entry) for entry in document):
        return {"sentences": len(document)}
    if key in ALIKE and document and isinstance(document[0], dict):
        return {"count": len(document), "keys": keys(document[0])}
    return [facts(entry, key, path) for entry in document]


def _of_covariance(matrix: np.ndarray[Any, np.dtype[np.float64]]) -> Any:
    """Return standard deviations, and what is below the diagonal of the correlations."""
    sigma = np.sqrt(np.diagonal(matrix))
    over = np.where(sigma > 0.0, sigma, np.inf)
    correlation = matrix / over[:, None] / over
    below = correlation[np.tril_indices(len(matrix), -1)]
    return {
        "symmetric": bool(np.allclose(matrix, matrix.T, rtol=1e-9)),
        "sigma": [float(f"{x:.{DIGITS}g}") for x in sigma],
        "correlation": [round(float(x), 4) + 0.0 for x in below],
    }


def _weak(weak: list[dict[str, Any]]) -> Any:
    """Return what does not depend on the basis that is chosen for the directions."""
    return {
        "count": len(weak),
        "keys": sorted({name for entry in weak for name in entry}),
        "harmless": sum(bool(entry.get("harmless")) for entry in weak),
        "parameters": sorted({name for entry in weak for name in entry.get("parameters", [])}),
    }


def _upright(quaternion: list[float]) -> list[float]:
    """Return the one of both quaternions of a rotation whose largest number is positive."""
    largest = max(quaternion, key=abs)
    return [-x if largest < 0.0 else x for x in quaternion]


def _is_sentence(text: str) -> bool:
    return " " in text or "/" in text


def keys(document: Any) -> Any:
    """Return the keys of a document at every level, and the types of what they hold."""
    if isinstance(document, dict):
        return {str(name): keys(value) for name, value in document.items()}
    if isinstance(document, list):
        return [keys(document[0])] if document else []
    if isinstance(document, bool) or document is None:
        return type(document).__name__
    return "number" if isinstance(document, int | float) else "text"


def folder_facts(folder: Path, printed: Any = None) -> dict[str, Any]:
    """Return what the files of a folder hold, by their relative paths."""
    return {
        path.relative_to(folder).as_posix(): file_facts(path, printed)
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.parent.name != ".schemas"
    }


def file_facts(path: Path, printed: Any = None) -> Any:
    """Return what a file holds; of tables their header and length, of pictures nothing."""
    if path.suffix == ".csv":
        with path.open(newline="", encoding="utf-8") as file:
            header, *rows = csv.reader(file)
        return {"header": ",".join(header), "rows": len(rows)}
    if path.suffix == ".json" and not path.name.startswith("."):
        document = json.loads(path.read_text(encoding="utf-8"))
        return "as printed" if document == printed else facts(document)
    if path.suffix == ".yaml":
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
        return "as printed" if document == printed else facts(document)
    if path.suffix == ".jsonl":
        lines = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return {"lines": len(lines), "keys": [keys(lines[0]), keys(lines[-1])]}
    return "file"


def table_facts(path: Path) -> dict[str, Any]:
    """Return a table with the sum and the sum of squares of every column of numbers."""
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    found: dict[str, Any] = {"rows": len(rows)}
    for name in rows[0] if rows else ():
        try:
            values = np.array([float(row[name]) for row in rows if row[name]])
        except ValueError:
            found[name] = len({row[name] for row in rows})
            continue
        found[name] = [float(f"{x:.{DIGITS}g}") for x in (values.sum(), np.square(values).sum())]
    return found
