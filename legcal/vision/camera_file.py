"""Camera files of ROS, OpenCV, Kalibr, mrcal, COLMAP, Basalt and MATLAB: read and written.

``_FORMATS`` lists the forms of mappings that are read, ``PARAMETERS`` the lens models of programs
that list all numbers of a camera in one row. Files are written for datasets as ROS has them, and
for four of these programs.
"""

from __future__ import annotations

import ast
import codecs
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import yaml
from pydantic import AfterValidator, BeforeValidator, ConfigDict, Field, model_validator

from legcal.errors import BadValue, DatasetError, UsageError
from legcal.files.folder import OutputFile, with_schema
from legcal.files.schema import FileSchema, content_of, describe, parse_yaml, validate
from legcal.geometry.types import Array
from legcal.vision.camera import (
    DISTORTION_MODELS,
    Camera,
    intrinsic_names,
    intrinsic_values,
    project_with_derivatives,
    with_intrinsics,
)
from legcal.vision.distortion import CameraProgram, DistortionModel
from legcal.vision.image_file import quiet_opencv, size_problem

_PixelCount = Annotated[int, Field(gt=0)]
Sigma = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
CALIBRATED = "legcal_camera"  # the key of the result of legcal camera


class _OpenSchema(FileSchema):
    """A block that may have keys of other programs."""

    model_config = ConfigDict(extra="ignore")


class MatrixEntry(_OpenSchema):
    """A matrix as ROS and OpenCV write it: its size, and its numbers row by row."""

    rows: int
    cols: int
    data: list[float]

    @model_validator(mode="after")
    def _is_complete(self) -> MatrixEntry:
        if self.rows * self.cols != len(self.data):
            raise ValueError(
                f"found {len(self.data)} numbers in a matrix of {self.rows} x {self.cols}, needed "
                f"{self.rows * self.cols}; correct rows, cols or data."
            )
        return self


def _is_3x3(matrix: MatrixEntry) -> MatrixEntry:
    """Refuse a camera matrix of another size."""
    if (matrix.rows, matrix.cols) != (3, 3):
        raise ValueError(
            f"found a matrix of {matrix.rows} x {matrix.cols}, needed 3 x 3; copy K from the "
            "calibration."
        )
    return matrix


CameraMatrix = Annotated[MatrixEntry, AfterValidator(_is_3x3)]


def _lens_of_name(name: object) -> object:
    """Return the lens model of a name; None for an empty one."""
    if name in (None, ""):
        return None
    for model, lens in DISTORTION_MODELS.items():
        if name in (model, *lens.aliases):
            return model
    raise BadValue(
        f"the lens model {describe(name)}",
        f"one that legcal reads ({', '.join(DISTORTION_MODELS)})",
        _CALIBRATE,
    )


_CALIBRATE = "calibrate the camera with legcal camera, or with such a lens in its program"
LensName = Annotated[DistortionModel | None, BeforeValidator(_lens_of_name)]
Size = tuple[_PixelCount, _PixelCount]

_Text = Annotated[str, Field(max_length=200)]
_Positive = Annotated[float, Field(gt=0.0)]
_Coordinate = Annotated[float, Field(allow_inf_nan=False)]


class PhotographsEntry(_OpenSchema):
    """Metadata of the photographs of the board: the distinct values of each fact."""

    device: list[_Text] = Field(default_factory=list)
    serial: list[_Text] = Field(default_factory=list)
    lens: list[_Text] = Field(default_factory=list)
    focal_length_mm: list[_Positive] = Field(default_factory=list)
    focal_length_35mm: list[_Positive] = Field(default_factory=list)
    digital_zoom: list[_Positive] = Field(default_factory=list)
    focus_distance_m: list[_Positive] = Field(default_factory=list)
    taken_size: list[tuple[_PixelCount, _PixelCount]] = Field(default_factory=list)
    software: list[_Text] = Field(default_factory=list)


class CalibratedEntry(_OpenSchema):
    """The uncertainty of the intrinsics, added by legcal to a camera that it calibrated."""

    version: Literal[1]
    sigma: dict[str, Sigma] = Field(default_factory=dict)
    names: list[str] | None = None  # of the rows of the covariance
    covariance: list[list[float]] | None = None
    # corners of the part of the image in which boards were seen [px]
    covered: list[tuple[_Coordinate, _Coordinate]] = Field(default_factory=list)
    photographs: PhotographsEntry = Field(default_factory=PhotographsEntry)


class RosEntry(_OpenSchema):
    """A ROS camera_info file."""

    image_width: _PixelCount
    image_height: _PixelCount
    camera_matrix: CameraMatrix
    distortion_model: LensName = None
    distortion_coefficients: MatrixEntry
    legcal_camera: CalibratedEntry | None = None


class RoiEntry(_OpenSchema):
    """The part of the sensor in the images of a ROS message; all zeros are the full image."""

    x_offset: int = 0
    y_offset: int = 0
    width: int = 0
    height: int = 0


class MessageEntry(_OpenSchema):
    """A ROS message of a camera, as ``ros2 topic echo`` prints it."""

    width: _PixelCount
    height: _PixelCount
    distortion_model: LensName
    d: list[float]
    k: Annotated[list[float], Field(min_length=9, max_length=9)]
    binning_x: int = 0
    binning_y: int = 0
    roi: RoiEntry = Field(default_factory=RoiEntry)


class KalibrEntry(_OpenSchema):
    """One camera of a Kalibr camchain."""

    distortion_model: LensName
    intrinsics: tuple[float, float, float, float]
    distortion_coeffs: list[float] = Field(default_factory=list)
    resolution: Size


class MrcalEntry(_OpenSchema):
    """A .cameramodel of mrcal."""

    lensmodel: str
    intrinsics: list[float]
    imagersize: Size


class BasaltCamera(_OpenSchema):
    """One camera of a calibration of Basalt."""

    camera_type: str
    intrinsics: dict[str, float]


class BasaltEntry(_OpenSchema):
    """The cameras of a calibration of Basalt."""

    intrinsics: Annotated[list[BasaltCamera], Field(min_length=1)]
    resolution: Annotated[list[Size], Field(min_length=1)]


def _as_3x3(rows: object) -> object:
    """Refuse what is not three rows of three entries."""
    lists = rows if isinstance(rows, list) else []
    if [len(row) if isinstance(row, list) else 0 for row in lists] != [3, 3, 3]:
        raise BadValue(
            describe(rows), "three rows of three numbers", "copy the matrix from the calibration"
        )
    return rows


_Rows = Annotated[list[list[float]], BeforeValidator(_as_3x3)]


class MatlabEntry(_OpenSchema):
    """The struct of MATLAB's camera parameters, as ``jsonencode`` writes it."""

    ImageSize: Size  # rows, columns
    RadialDistortion: Annotated[list[float], Field(min_length=2, max_length=3)]
    TangentialDistortion: Annotated[list[float], Field(min_length=2, max_length=2)]
    K: _Rows | None = None
    IntrinsicMatrix: _Rows | None = None  # the transpose of K, before R2022b


_OPENCV_MARKS = re.compile(rb"\A\s*(%YAML:1\.0|<\?xml|<opencv_storage)|opencv-matrix")
_OPENCV_KEYS = {
    "image_width": ("image_width", "image_Width"),
    "image_height": ("image_height", "image_Height"),
    "camera_matrix": ("camera_matrix", "Camera_Matrix"),
    "distortion_model": ("distortion_model",),
    "distortion_coefficients": ("distortion_coefficients", "Distortion_Coefficients"),
    "fisheye_model": ("fisheye_model",),
    "camera_model": ("camera_model", "Camera_Model", "cameraModel"),
}
_YAML_HEADER = re.compile(rb"\A\s*%YAML[^\n]*\n")
_SEPARATOR = re.compile(rb"^---[^\n]*$", re.MULTILINE)  # of messages
_LAST_SEPARATOR = re.compile(rb"(?<=\n)---\s*\Z")
_COLMAP = re.compile(rb"(\d+)\s+([A-Z][A-Z0-9_]+)(?:\s+(.*))?")  # one line
_OLD_LENSMODEL = "lens_model"  # the key lensmodel in older files of mrcal
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_PINHOLE = "fx fy cx cy"
_OPENCV4, _FISHEYE = f"{_PINHOLE} k1 k2 p1 p2", f"{_PINHOLE} k1 k2 k3 k4"
PARAMETERS: Mapping[str, Mapping[str, tuple[DistortionModel, str]]] = {
    "mrcal": {
        "LENSMODEL_PINHOLE": ("plumb_bob", _PINHOLE),
        "LENSMODEL_OPENCV4": ("plumb_bob", _OPENCV4),
        "LENSMODEL_OPENCV5": ("plumb_bob", f"{_OPENCV4} k3"),
        "LENSMODEL_OPENCV8": ("rational_polynomial", f"{_OPENCV4} k3 k4 k5 k6"),
        "LENSMODEL_OPENCV12": ("thin_prism", f"{_OPENCV4} k3 k4 k5 k6 s1 s2 s3 s4"),
    },
    "COLMAP": {
        "SIMPLE_PINHOLE": ("plumb_bob", "f cx cy"),
        "PINHOLE": ("plumb_bob", _PINHOLE),
        "SIMPLE_RADIAL": ("plumb_bob", "f cx cy k1"),
        "RADIAL": ("plumb_bob", "f cx cy k1 k2"),
        "OPENCV": ("plumb_bob", _OPENCV4),
        "FULL_OPENCV": ("rational_polynomial", f"{_OPENCV4} k3 k4 k5 k6"),
        "OPENCV_FISHEYE": ("equidistant", _FISHEYE),
        "SIMPLE_RADIAL_FISHEYE": ("equidistant", "f cx cy k1"),
        "RADIAL_FISHEYE": ("equidistant", "f cx cy k1 k2"),
    },
    "Basalt": {
        "pinhole": ("plumb_bob", _PINHOLE),
        "pinhole-radtan8": ("rational_polynomial", f"{_OPENCV4} k3 k4 k5 k6"),
        "kb4": ("equidistant", _FISHEYE),
    },
}
_SIGMAS = (1e-12, 1e6)  # plausible standard deviations of an intrinsic [px, or none]
_ROUNDING = 1e-9  # rounding of correlations
_SIGMA_DIGITS = 1e-4  # relative precision of written standard deviations
_SINGULAR = 1e-9  # minimum focal length, in units of the image size


def read_camera(path: Path) -> Camera:
    """Read a camera file of any program in ``_FORMATS``."""
    document = _document(content_of(path, "camera file"), path)
    for _, is_in, read in _FORMATS:
        if is_in(document):
            return read(document, path)
    raise DatasetError(
        f"{path}: the camera file could not be read: found the keys "
        f"{', '.join(list(document)[:8]) or 'none'}, needed those of "
        f"{', '.join(name for name, _, _ in _FORMATS)}; write the calibration in one of these "
        "forms."
    )


def calibrated_block(path: Path) -> Mapping[str, Any] | None:
    """Return what legcal adds to a camera that it calibrated, as it stands in a camera file."""
    block = _document(content_of(path, "camera file"), path).get(CALIBRATED)
    return block if isinstance(block, dict) else None


def _document(content: bytes, path: Path) -> Mapping[str, Any]:
    """Return the mapping in a camera file of any syntax."""
    if b"LENSMODEL_" in content and (literal := _literal(content)):
        if _OLD_LENSMODEL in literal:
            literal.setdefault("lensmodel", literal.pop(_OLD_LENSMODEL))
        return literal
    if rows := _colmap_rows(content):
        return {"colmap": rows}
    bare = _YAML_HEADER.sub(b"", content)
    if _OPENCV_MARKS.search(content):
        is_camchain = b"opencv-matrix" not in content and re.search(
            rb"^cam\d+:", bare, re.MULTILINE
        )
        return (
            parse_yaml(bare, path, "camera file") if is_camchain else _read_storage(content, path)
        )
    content = _LAST_SEPARATOR.sub(b"", content)
    messages = [text for text in _SEPARATOR.split(content) if text.strip()]
    if len(messages) < 2:
        return parse_yaml(content, path, "camera file")
    first, *others = (parse_yaml(text, path, "camera file") for text in messages)
    numbers = set(first) - {"header"}
    if any(other.get(key) != first[key] for other in others for key in numbers):
        raise DatasetError(
            f"{path}: the camera file could not be used: found messages of different cameras, "
            "needed one camera; copy one message into a file of its own."
        )
    return first


def _colmap_rows(content: bytes) -> list[tuple[str, str, str]]:
    """Return number, lens and the rest of the lines of a cameras.txt; none of another file."""
    lines = [line.strip() for line in content.removeprefix(codecs.BOM_UTF8).splitlines()]
    rows = [_COLMAP.fullmatch(line) for line in lines if line and not line.startswith(b"#")]
    found = [row.groups(default=b"") for row in rows if row]
    if len(found) < len(rows):
        return []
    return [
        (number.decode(), lens.decode(), rest.decode(errors="replace"))
        for number, lens, rest in found
    ]


def _literal(content: bytes) -> dict[str, Any]:
    """Return the mapping that mrcal writes, a literal of Python; empty if it is none."""
    try:
        document = ast.literal_eval(content.decode())
    except (ValueError, SyntaxError, MemoryError, RecursionError):
        return {}
    return document if isinstance(document, dict) else {}


def _is_kalibr(value: object) -> bool:
    """Return whether a block looks like one camera of a Kalibr camchain."""
    return isinstance(value, dict) and ("intrinsics" in value or "camera_model" in value)


def _from_ros(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the camera of a ROS camera_info file or an OpenCV FileStorage."""
    entry = validate(RosEntry, document, path)
    camera = _checked(
        path,
        _matrix(entry.camera_matrix),
        (entry.image_width, entry.image_height),
        entry.distortion_model,
        entry.distortion_coefficients.data,
    )
    if entry.legcal_camera is None:
        return camera
    photographs = entry.legcal_camera.photographs.model_dump()
    recorded = {name: values for name, values in photographs.items() if values}
    covariance = _covariance(entry.legcal_camera, camera, path)
    covered = np.array(entry.legcal_camera.covered).reshape(-1, 2)
    return replace(camera, covariance=covariance, photographs=recorded, covered=covered)


def _covariance(entry: CalibratedEntry, camera: Camera, path: Path) -> Array | None:
    """Return the covariance of all intrinsics, None where only standard deviations are stated."""
    intrinsics, names = intrinsic_names(camera), entry.names or []
    unknown = [name for name in (*entry.sigma, *names) if name not in intrinsics]
    if unknown:
        raise DatasetError(
            f"{path}: {CALIBRATED} could not be used: found {', '.join(unknown)}, needed names of "
            f"{camera.model}: {', '.join(intrinsics)}; calibrate the camera again."
        )
    if entry.names is None and entry.covariance is None:
        return None
    rows = entry.covariance or []
    problem = _covariance_problem(rows, names, entry.sigma)
    if entry.names is None or entry.covariance is None:
        problem = f"no {'names' if entry.names is None else 'covariance'}"
    if problem:
        raise DatasetError(
            f"{path}: {CALIBRATED}.covariance could not be used: found {problem}, needed names and "
            "their covariance; calibrate the camera again, or correct the block."
        )
    C = np.array(rows).reshape(len(names), len(names))
    indices = [intrinsics.index(name) for name in names]
    covariance = np.zeros((len(intrinsics), len(intrinsics)))
    covariance[np.ix_(indices, indices)] = 0.5 * (C + C.T)
    return covariance


def _covariance_problem(
    rows: Sequence[Sequence[float]], names: Sequence[str], sigma: Mapping[str, float]
) -> str:
    """Return why rows are no covariance with plausible, or stated, deviations; "" if they are."""
    n, (least, most) = len(names), _SIGMAS
    if len(set(names)) < n or [len(row) for row in rows] != n * [n]:
        return f"{len(rows)} rows that are not {n} of {n} numbers for distinct names"
    C = np.array(rows).reshape(n, n)
    variance = np.diagonal(C)
    is_exact = variance == 0.0
    implausible = ~is_exact & ~((variance >= least**2) & (variance <= most**2))
    if implausible.any():
        i = int(np.argmax(implausible))
        return f"the variance {variance[i]:g} of {names[i]}, no square of {least:g} to {most:g}"
    deviation = np.sqrt(variance)
    bound = (1.0 + _ROUNDING) * np.outer(deviation, deviation)
    scale = np.where(is_exact, 1.0, deviation)
    correlation = np.clip(C, -2.0 * bound, 2.0 * bound) / np.outer(scale, scale)
    if np.abs(correlation - correlation.T).max(initial=0.0) > _ROUNDING:
        return "a matrix that is not symmetric"
    least_eigenvalue = float(np.linalg.eigvalsh(correlation).min(initial=0.0))
    if np.any(np.abs(C) > bound) or least_eigenvalue < -_ROUNDING:
        return "a matrix that is not positive semidefinite"
    for name, s in zip(names, deviation.tolist(), strict=True):
        if abs(sigma.get(name, s) - s) > _SIGMA_DIGITS * s:
            return f"the standard deviation {s:g} of {name}, unlike {sigma[name]:g} in sigma"
    return ""


def _from_message(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the camera of a ROS message; ROS 1 has capital letters."""
    small = {"d": document.get("D", []), "k": document.get("K"), "distortion_model": ""}
    entry = validate(MessageEntry, {**small, **document}, path)
    part = entry.roi
    problems = [
        f"{path}: {key} could not be used: found {binning}, needed 0 or 1, as k is for images that "
        "are not binned; calibrate the camera at the size of the images."
        for key, binning in (("binning_x", entry.binning_x), ("binning_y", entry.binning_y))
        if binning not in (0, 1)
    ]
    if (
        (part.x_offset, part.y_offset) != (0, 0)
        or part.width not in (0, entry.width)
        or part.height not in (0, entry.height)
    ):
        problems.append(
            f"{path}: roi could not be used: found {part.width} x {part.height} px at "
            f"({part.x_offset}, {part.y_offset}), needed the full image of {entry.width} x "
            f"{entry.height} px; calibrate the camera at the size of the images."
        )
    if problems:
        raise DatasetError(problems)
    K = np.reshape(entry.k, (3, 3))
    return _checked(path, K, (entry.width, entry.height), entry.distortion_model, entry.d)


def _from_kalibr(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the only camera of a Kalibr camchain."""
    cameras = [key for key, value in document.items() if _is_kalibr(value)]
    prefix = _only(cameras, path)
    block = document[prefix] if prefix else document
    if block.get("camera_model") != "pinhole":
        raise DatasetError(
            f"{path}: {prefix}{'.' * bool(prefix)}camera_model could not be used: found "
            f"{describe(block.get('camera_model'))}, needed pinhole; calibrate the camera with "
            "pinhole-radtan or pinhole-equi, or with legcal camera."
        )
    entry = validate(KalibrEntry, block, path, prefix)
    K = _pinhole(*entry.intrinsics)
    coefficients, problems = entry.distortion_coeffs, []
    needed = 0 if block["distortion_model"] == "none" else 4
    if len(coefficients) != needed and (needed or any(coefficients)):
        n = len(coefficients)
        problems.append(_wrong_count(path, str(block["distortion_model"]), n, str(needed)))
    coefficients = (coefficients + 4 * [0.0])[:needed]
    return _checked(path, K, entry.resolution, entry.distortion_model, coefficients, problems)


def _pinhole(fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return a camera matrix (3, 3)."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _only(cameras: Sequence[str], path: Path) -> str:
    """Return the name of the only camera of a file, "" without a name."""
    if len(cameras) > 1:
        raise DatasetError(
            f"{path}: the camera file could not be used: found {len(cameras)} cameras "
            f"({', '.join(cameras)}), needed one camera a file; copy each camera into a file of "
            "its own and name that file in its view."
        )
    return cameras[0] if cameras else ""


def _from_mrcal(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the camera of a .cameramodel of mrcal."""
    entry = validate(MrcalEntry, document, path)
    return _of_parameters(path, "mrcal", entry.lensmodel, entry.intrinsics, entry.imagersize)


def _from_colmap(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the only camera of a cameras.txt of COLMAP: the corner of the image is its origin."""
    rows = document["colmap"]
    _only([f"camera {number}" for number, _, _ in rows], path)
    number, lens, listed = rows[0]
    words = listed.split()
    values = [float(word) if _NUMBER.fullmatch(word) else np.nan for word in words]
    size = [int(value) for value in values[:2] if value > 0.0 and value.is_integer()]
    wrong = [word for word, value in zip(words, values, strict=True) if not np.isfinite(value)]
    if len(size) < 2 or wrong:
        found = wrong[0] if wrong else " ".join(words[:2])
        raise DatasetError(
            f"{path}: camera {number} could not be read: found {describe(found)}, needed the "
            f"width and height of the image [px] and the parameters of {lens}; copy the line from "
            "COLMAP's cameras.txt."
        )
    return _of_parameters(path, "COLMAP", lens, values[2:], (size[0], size[1]), first_pixel=0.5)


def _from_basalt(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the only camera of a calibration of Basalt."""
    entry = validate(BasaltEntry, document["value0"], path, "value0")
    _only([f"camera {k}" for k in range(len(entry.intrinsics))], path)
    camera = entry.intrinsics[0]
    names = PARAMETERS["Basalt"].get(camera.camera_type, ("", ""))[1].split()
    parameters = [camera.intrinsics[name] for name in names if name in camera.intrinsics]
    return _of_parameters(path, "Basalt", camera.camera_type, parameters, entry.resolution[0])


def _from_matlab(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the camera of MATLAB's struct: its first pixel is (1, 1)."""
    entry = validate(MatlabEntry, document, path)
    transposed = None if entry.IntrinsicMatrix is None else np.transpose(entry.IntrinsicMatrix)
    by_rows = transposed if entry.K is None else np.array(entry.K)
    if by_rows is None:
        raise DatasetError(
            f"{path}: K could not be read: found no such key, needed it; add 'K: ...' to the file."
        )
    K = by_rows - [[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]]
    height, width = entry.ImageSize
    k1, k2, *k3 = entry.RadialDistortion
    coefficients = [k1, k2, *entry.TangentialDistortion, *(k3 or [0.0])]
    return _checked(path, K, (width, height), "plumb_bob", coefficients)


def _of_parameters(
    path: Path,
    program: str,
    lens: str,
    parameters: Sequence[float],
    size: tuple[int, int],
    first_pixel: float = 0.0,  # coordinates of its centre
) -> Camera:
    """Return the camera of a lens in ``PARAMETERS``."""
    if lens not in PARAMETERS[program]:
        raise DatasetError(
            f"{path}: the lens model could not be used: found {describe(lens)}, needed one of "
            f"{program} that legcal reads ({', '.join(PARAMETERS[program])}); {_CALIBRATE}."
        )
    model, listed = PARAMETERS[program][lens]
    names = listed.split()
    if len(parameters) != len(names):
        raise DatasetError(
            f"{path}: the lens model {lens} could not be used: found {len(parameters)} parameters, "
            f"needed {len(names)} ({', '.join(names)}); copy all of them from the calibration."
        )
    value = dict(zip(names, parameters, strict=True))
    fx, fy = (value.get(name, value.get("f", 0.0)) for name in ("fx", "fy"))
    K = _pinhole(fx, fy, value["cx"] - first_pixel, value["cy"] - first_pixel)
    coefficients = [value.get(name, 0.0) for name in DISTORTION_MODELS[model].coefficients]
    return _checked(path, K, size, model, coefficients)


def _read_storage(content: bytes, path: Path) -> dict[str, Any]:
    """Return the entries of an OpenCV FileStorage that describe a camera."""
    reason = "a storage that OpenCV cannot parse"
    try:
        with quiet_opencv():
            storage = cv2.FileStorage(
                content.decode("utf-8-sig"), cv2.FILE_STORAGE_READ | cv2.FILE_STORAGE_MEMORY
            )
            nodes = {
                name: node
                for name, names in _OPENCV_KEYS.items()
                for node in [next((n for n in map(storage.getNode, names) if not n.empty()), None)]
                if node is not None
            }
            document = {name: _node_value(node) for name, node in nodes.items()}
            return _with_lens(document, path)
    except UnicodeDecodeError:
        reason = "bytes that are not UTF-8 text"
    except (cv2.error, SystemError):
        pass
    raise DatasetError(
        f"{path}: the camera file could not be read: found {reason}, needed an OpenCV FileStorage "
        "in YAML, XML or JSON; write it again with cv2.FileStorage."
    )


def _with_lens(document: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the entries of a storage with the lens that its other keys name as its distortion."""
    fisheye, camera = (document.pop(key, None) for key in ("fisheye_model", "camera_model"))
    D = document.get("distortion_coefficients")
    if fisheye is not None and isinstance(D, dict):
        lens = "equidistant" if fisheye else _counted(D["data"])
        document.setdefault("distortion_model", lens)
    name = str(camera or "pinhole").lower()
    if name == "pinhole":  # with any distortion
        return document
    start = f"{path}: camera_model could not be used: found {describe(camera)}"
    for model, kind in DISTORTION_MODELS.items():
        names = (model, *kind.aliases)
        if name not in names:
            continue
        if (stated := document.setdefault("distortion_model", model)) not in names:
            raise DatasetError(
                f"{start} beside the distortion {describe(stated)}, needed one lens model; correct "
                "the one that is wrong."
            )
        return document
    raise DatasetError(
        f"{start}, needed pinhole or a lens that legcal reads ({', '.join(DISTORTION_MODELS)}); "
        f"{_CALIBRATE}."
    )


def _node_value(node: cv2.FileNode) -> object:
    """Return a FileStorage node as plain numbers, texts and matrices."""
    if node.isMap():
        matrix = node.mat()
        if matrix is None or matrix.ndim != 2:
            return "an entry that is not a matrix"
        return {"rows": matrix.shape[0], "cols": matrix.shape[1], "data": matrix.ravel().tolist()}
    if node.isInt() or node.isReal():
        return node.real()
    return node.string() if node.isString() else "a list"


def _matrix(entry: MatrixEntry) -> Array:
    """Return a matrix entry as an array."""
    return np.array(entry.data, dtype=np.float64).reshape(entry.rows, entry.cols)


def _wrong_count(path: Path, model: str, n_coefficients: int, needed: str) -> str:
    """Return the problem of a wrong number of distortion coefficients."""
    remedy = "copy all of them from the calibration"
    if n_coefficients > 5:
        remedy = "name the lens model that has so many, or " + _CALIBRATE
    return (
        f"{path}: the distortion could not be used: found {n_coefficients} coefficients, needed "
        f"{needed} for {model}; {remedy}."
    )


def _counted(coefficients: Sequence[float]) -> DistortionModel:
    """Return the polynomial lens of OpenCV with so many coefficients."""
    return "rational_polynomial" if len(coefficients) > 5 else "plumb_bob"


def _without_padding(model: DistortionModel, distortion: Array) -> tuple[DistortionModel, Array]:
    """Return a polynomial lens of OpenCV without trailing zeros of richer ones.

    Of rational_polynomial five coefficients are those of plumb_bob, and twelve a thin prism.
    """
    if DISTORTION_MODELS[model].is_fisheye:
        return model, distortion
    if len(distortion) == 14 and not distortion[12:].any():
        distortion = distortion[:12]
    if model == "rational_polynomial" and len(distortion) == 12 and distortion[8:].any():
        model = "thin_prism"
    n = {"plumb_bob": 5, "rational_polynomial": 8, "thin_prism": 12}[model]
    if len(distortion) in (8, 12) and not distortion[n:].any():
        distortion = distortion[:n]
    is_plain = model == "rational_polynomial" and len(distortion) in (4, 5)
    return "plumb_bob" if is_plain else model, distortion


def _checked(
    path: Path,
    K: Array,
    size: tuple[int, int],
    model: DistortionModel | None,
    coefficients: Sequence[float],
    problems: Sequence[str] = (),
) -> Camera:
    """Return a camera; refuse numbers that no camera has.

    Without a model the number of coefficients says which it is, unless it may be two.
    """
    problems = list(problems)
    if model is None and len(coefficients) == 4 and any(coefficients):
        problems.append(
            f"{path}: the distortion could not be used: found four coefficients without a lens "
            "model, which may be those of plumb_bob (k1, k2, p1, p2) or of a fisheye (k1, k2, k3, "
            "k4), needed its name; add 'distortion_model: plumb_bob' or 'distortion_model: "
            "equidistant' to the file."
        )
    model, distortion = _without_padding(
        model or _counted(coefficients), np.array(coefficients, dtype=np.float64)
    )
    counts = DISTORTION_MODELS[model].counts
    if len(distortion) == 14:
        problems.append(
            f"{path}: the distortion could not be used: found 14 coefficients with the tilt of a "
            f"sensor, needed at most 12; {_CALIBRATE}."
        )
    elif len(distortion) not in counts:
        needed = " or ".join(str(n) for n in counts)
        problems.append(_wrong_count(path, model, len(distortion), needed))
    if problem := size_problem(*size):
        problems.append(
            f"{path}: the image size could not be used: found {problem[0]}, needed {problem[1]}; "
            "calibrate at the size of the images."
        )
    problems += _matrix_problems(path, K, size)
    if not np.all(np.isfinite(distortion)):
        problems.append(
            f"{path}: the distortion could not be used: found a coefficient that is not finite, "
            "needed numbers; calibrate the camera again."
        )
    if problems:
        raise DatasetError(problems)
    camera = Camera(K, size[0], size[1], distortion, model)
    if (angle := camera.turns_back) is not None:
        raise DatasetError(
            f"{path}: the distortion could not be used: found a spline whose radius stops growing "
            f"{np.rad2deg(angle):.0f} deg from the axis, inside the image, needed one that grows "
            "as far as the corners of the image; calibrate again with boards in these corners."
        )
    return camera


def _matrix_problems(path: Path, K: Array, size: tuple[int, int]) -> list[str]:
    """Return the problems of a camera matrix, one sentence each."""
    start = f"{path}: the camera matrix could not be used: found"
    if not np.all(np.isfinite(K)):
        return [f"{start} a value that is not finite, needed numbers; calibrate the camera again."]
    problems = []
    if not np.array_equal(K[2], [0.0, 0.0, 1.0]) or K[1, 0] != 0.0:
        problems.append(
            f"{start} {K.tolist()}, needed [[fx, s, cx], [0, fy, cy], [0, 0, 1]]; write the matrix "
            "row by row, divided by its last element."
        )
    for name, focal, extent in (("fx", K[0, 0], size[0]), ("fy", K[1, 1], size[1])):
        if focal < _SINGULAR * extent or focal == 0.0:
            problems.append(
                f"{start} {name} = {focal:g}, needed a focal length above 0 px; write the matrix "
                "of the calibration, for x to the right and y down."
            )
    for name, centre, extent in (("cx", K[0, 2], size[0]), ("cy", K[1, 2], size[1])):
        if not -0.5 <= centre <= extent - 0.5:
            problems.append(
                f"{start} {name} = {centre:g}, needed a principal point inside the image of "
                f"{size[0]} x {size[1]} px; calibrate at the size of the images."
            )
    return problems


_Reader = Callable[[Mapping[str, Any], Path], Camera]
_FORMATS: tuple[tuple[str, Callable[[Mapping[str, Any]], bool], _Reader], ...] = (
    ("COLMAP's cameras.txt", lambda d: "colmap" in d, _from_colmap),
    ("mrcal's .cameramodel", lambda d: "lensmodel" in d, _from_mrcal),
    ("a calibration of Basalt", lambda d: isinstance(d.get("value0"), dict), _from_basalt),
    (
        "a Kalibr camchain (cam0: camera_model, ...)",
        lambda d: _is_kalibr(d) or any(map(_is_kalibr, d.values())),
        _from_kalibr,
    ),
    (
        "a ROS message (width, k, d, ...)",
        lambda d: "k" in d or ("K" in d and "D" in d),
        _from_message,
    ),
    ("MATLAB's struct as JSON", lambda d: "RadialDistortion" in d, _from_matlab),
    (
        "a ROS camera_info or an OpenCV FileStorage (camera_matrix, ...)",
        lambda d: "camera_matrix" in d or "image_width" in d,
        _from_ros,
    ),
)


_MARK = "# camera converted by legcal\n"
CONVERTED = OutputFile(
    "the camera", "camera file", "", "a new file or one that this command wrote", _MARK.encode()
)


def camera_info(camera: Camera, name: str, more: Mapping[str, Any] | None = None) -> str:
    """Return the text of a ROS camera_info file that reads back as the same camera."""
    distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
    projection = np.column_stack([camera.K, np.zeros(3)])
    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": camera.K.ravel().tolist()},
        # ROS passes on any number of coefficients of this name to OpenCV.
        "distortion_model": (
            "rational_polynomial" if camera.model == "thin_prism" else camera.model
        ),
        "distortion_coefficients": {
            "rows": 1,
            "cols": len(distortion),
            "data": distortion.tolist(),
        },
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": projection.ravel().tolist()},
        **(more or {}),
    }
    text = yaml.safe_dump(document, sort_keys=False, default_flow_style=None, width=100)
    return with_schema("camera", text)


def rough_camera_info(camera: Camera, name: str) -> str:
    """Return the text of the camera file of a rough camera, with its covariance."""
    names = intrinsic_names(camera)
    C = np.zeros((len(names), len(names))) if camera.covariance is None else camera.covariance
    inexact = [i for i in range(len(names)) if C[i, i] > 0.0]
    stated = {
        "version": 1,
        "sigma": {names[i]: float(np.sqrt(C[i, i])) for i in inexact},
        "names": [names[i] for i in inexact],
        "covariance": C[np.ix_(inexact, inexact)].tolist(),
    }
    return camera_info(camera, name, {CALIBRATED: stated})


def convert_camera(path: Path, program: CameraProgram, output: Path) -> list[str]:
    """Write a camera file in the form of a program; return lines that say what was done.

    The covariance of a camera that legcal calibrated is kept for ros, which alone can hold it. A
    splined lens, which no other program reads, becomes the nearest one that the program has, and
    one with k3 the nearest one of kalibr, which has none.

    Raises DatasetError if the camera file cannot be read; UsageError if the program has no such
    lens, or if another file stands there.
    """
    CONVERTED.check_place(output)
    camera, block = read_camera(path), calibrated_block(path)
    lines = [f"written: {output}"]
    why, spoken = "", {"kalibr": _SPOKEN[:1], "mrcal": _SPOKEN[1:]}.get(program, _SPOKEN)
    if not DISTORTION_MODELS[camera.model].is_of_opencv:
        why = f"Only legcal reads the lens {camera.model}"
    elif program == "kalibr" and camera.model == "plumb_bob" and any(camera.distortion[4:]):
        why, spoken = "The lenses of kalibr have no k3", ("plumb_bob", "equidistant")
    if why:
        ways = [_nearest(camera, model) for model in spoken]
        off_px = min(off for _, off in ways)
        camera = next(nearest for nearest, off in ways if off == off_px)
        lines.append(
            f"{why}: written as the nearest {camera.model}, at most {off_px:.2g} px off over the "
            "image."
        )
        if block:
            lines.append(f"Its covariance is left out; a session that is to use it needs {path}.")
        block = None
    more = {CALIBRATED: block} if block and program == "ros" else None
    text = camera_text(camera, program, output.stem, more)
    CONVERTED.write(output, text.replace("\n", f"\n{_MARK}", 1))
    if block and not more:
        lines.append(
            f"The covariance of the camera is left out, as files of {program} do not hold it; a "
            f"session that is to use it needs {path}."
        )
    return lines


_SPOKEN: tuple[DistortionModel, ...] = ("equidistant", "rational_polynomial")
_SIDES = 33, 25  # places along both sides of the image at which cameras are compared


def _nearest(camera: Camera, model: DistortionModel) -> tuple[Camera, float]:
    """Return the camera of a model that projects like another one, and how far it is off [px].

    Least squares of pixels all over the image; the largest distance between them is returned. Of
    plumb_bob k3 stays zero.
    """
    pixels = camera.grid(*_SIDES)
    pixels = pixels[camera.reaches(pixels)]
    xy = camera.undistort(pixels)
    rays = np.column_stack([xy, np.ones(len(xy))])
    r = np.linalg.norm(xy, axis=1)
    radius = np.linalg.norm((pixels - camera.K[:2, 2]) / np.diag(camera.K)[:2], axis=1)
    away = np.arctan(r) if DISTORTION_MODELS[model].is_fisheye else r
    times = radius / np.maximum(away, 1e-9)
    powers = away[:, None] ** (2.0 * np.arange(1, 3 if model == "plumb_bob" else 5))
    if model == "rational_polynomial":  # times its denominator
        powers = np.hstack([powers[:, :3], -times[:, None] * powers[:, :3]])
    k = np.linalg.lstsq(powers, times - 1.0, rcond=None)[0]
    radial = k if model == "equidistant" else np.concatenate([k[:2], [0.0, 0.0], k[2:]])
    start = replace(camera, distortion=radial, model=model, covariance=None)
    numbers = dict(zip(intrinsic_names(start), intrinsic_values(start).tolist(), strict=True))
    names = [name for name in numbers if (model, name) != ("plumb_bob", "k3")]

    def of(values: Array) -> Camera:
        return with_intrinsics(start, dict(zip(names, values.tolist(), strict=True)))

    def jacobian(values: Array) -> Array:
        return project_with_derivatives(of(values), rays, names)[2].reshape(-1, len(names))

    def residual(values: Array) -> Array:
        return np.ravel(of(values).distort(xy) - pixels)

    from scipy.optimize import least_squares  # only where a camera is converted

    values = [numbers[name] for name in names]
    best = of(least_squares(residual, values, jac=jacobian, x_scale="jac", method="lm").x)
    return best, float(np.linalg.norm(best.distort(xy) - pixels, axis=1).max())


def camera_text(
    camera: Camera, program: CameraProgram, name: str, more: Mapping[str, Any] | None = None
) -> str:
    """Return the text of a camera file in the form of a program; only ros has more entries.

    Raises UsageError if the program has no such lens.
    """
    if program == "ros":
        return camera_info(camera, name, more)
    D = camera.distortion.tolist()
    if camera.K[0, 1] != 0.0:
        raise _no_such_lens(camera, program, "a camera without skew")
    numbers = [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2]]
    pinhole = [float(number) for number in numbers]
    if program == "opencv":
        return _storage(camera)
    if program == "mrcal":
        n = len(pinhole) + len(D)
        for lens, (model, parameters) in PARAMETERS["mrcal"].items():
            if (model, len(parameters.split())) == (camera.model, n):
                size = [camera.width, camera.height]
                return (
                    f"{{\n    'lensmodel':  '{lens}',\n    'extrinsics': {[0.0] * 6},\n"
                    f"    'intrinsics': {pinhole + D},\n    'imagersize': {size},\n}}\n"
                )
        raise _no_such_lens(camera, program, "plumb_bob, rational_polynomial or thin_prism")
    lens = {"plumb_bob": "radtan", "equidistant": "equidistant"}.get(camera.model, "")
    if not lens or (lens == "radtan" and any(D[4:])):
        raise _no_such_lens(camera, program, "radtan (plumb_bob) or equidistant")
    block = {
        "cam_overlaps": [],
        "camera_model": "pinhole",
        "distortion_coeffs": D[:4] or [0.0] * 4,
        "distortion_model": lens,
        "intrinsics": pinhole,
        "resolution": [camera.width, camera.height],
    }
    return yaml.safe_dump({"cam0": block}, sort_keys=False, default_flow_style=None, width=1000)


def _no_such_lens(camera: Camera, program: CameraProgram, needed: str) -> UsageError:
    """Return the error for a camera that a program cannot hold."""
    skew = " with skew" if camera.K[0, 1] != 0.0 else ""
    return UsageError(
        f"The camera could not be written for {program}: found the lens {camera.model}{skew}, "
        f"needed {needed}; choose another program, or calibrate with another --model."
    )


def _storage(camera: Camera) -> str:
    """Return the text of an OpenCV FileStorage."""
    storage = cv2.FileStorage("camera.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_width", camera.width)
    storage.write("image_height", camera.height)
    storage.write("camera_matrix", camera.K)
    storage.write("distortion_model", camera.model)
    D = camera.distortion if len(camera.distortion) else np.zeros(5)
    storage.write("distortion_coefficients", D[:, None])
    storage.write("fisheye_model", int(camera.model == "equidistant"))
    return str(storage.releaseAndGetString())
