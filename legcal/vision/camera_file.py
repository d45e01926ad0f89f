"""Camera files: ROS camera_info, OpenCV and Kalibr read, ROS written."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import yaml
from pydantic import AfterValidator, ConfigDict, Field, model_validator

from legcal.errors import DatasetError
from legcal.files.published import with_schema
from legcal.files.schema import FileSchema, content_of, parse_yaml, validate
from legcal.geometry.types import Array
from legcal.vision.camera import DISTORTION_MODELS, Camera, intrinsic_names
from legcal.vision.distortion import DistortionModel
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
    def _is_complete(self) -> "MatrixEntry":
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


_Text = Annotated[str, Field(max_length=200)]
_Positive = Annotated[float, Field(gt=0.0)]


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
    sigma: dict[str, Sigma]
    names: list[str] | None = None  # of the rows of the covariance
    covariance: list[list[float]] | None = None
    photographs: PhotographsEntry = Field(default_factory=PhotographsEntry)


class RosEntry(_OpenSchema):
    """A ROS camera_info file."""

    image_width: _PixelCount
    image_height: _PixelCount
    camera_matrix: CameraMatrix
    distortion_model: DistortionModel = "plumb_bob"
    distortion_coefficients: MatrixEntry
    legcal_camera: CalibratedEntry | None = None


class OpenCVEntry(_OpenSchema):
    """An OpenCV FileStorage, as its calibration sample writes it."""

    image_width: _PixelCount
    image_height: _PixelCount
    camera_matrix: CameraMatrix
    distortion_coefficients: MatrixEntry
    fisheye_model: int = 0


class KalibrEntry(_OpenSchema):
    """One camera of a Kalibr camchain."""

    camera_model: Literal["pinhole"]
    distortion_model: Literal["radtan", "equidistant", "none"]
    intrinsics: tuple[float, float, float, float]
    distortion_coeffs: list[float] = Field(default_factory=list)
    resolution: tuple[_PixelCount, _PixelCount]


_OPENCV_MARKS = re.compile(rb"\A\s*(%YAML:1\.0|<\?xml|<opencv_storage)|opencv-matrix")
_OPENCV_KEYS = {
    "image_width": ("image_width", "image_Width"),
    "image_height": ("image_height", "image_Height"),
    "camera_matrix": ("camera_matrix", "Camera_Matrix"),
    "distortion_coefficients": ("distortion_coefficients", "Distortion_Coefficients"),
    "fisheye_model": ("fisheye_model",),
}
_SIGMAS = (1e-12, 1e6)  # plausible standard deviations of an intrinsic [px, or none]
_ROUNDING = 1e-9  # rounding of correlations
_SIGMA_DIGITS = 1e-4  # relative precision of written standard deviations
_SINGULAR = 1e-9  # minimum focal length, in units of the image size


def read_camera(path: Path) -> Camera:
    """Read a camera file of any of the three kinds."""
    content = content_of(path, "camera file")
    if _OPENCV_MARKS.search(content):
        return _from_opencv(_read_storage(content, path), path)
    document = parse_yaml(content, path, "camera file")
    cameras = [key for key, value in document.items() if _is_kalibr(value)]
    if cameras or _is_kalibr(document):
        return _from_kalibr(document, cameras, path)
    if "camera_matrix" in document:
        return _from_ros(document, path)
    raise DatasetError(
        f"{path}: the camera file could not be read: found the keys "
        f"{', '.join(list(document)[:8]) or 'none'}, needed those of a ROS camera_info "
        "(camera_matrix, distortion_model, ...), of an OpenCV FileStorage or of a Kalibr camchain "
        "(cam0: camera_model, intrinsics, ...); write the calibration in one of these forms."
    )


def _is_kalibr(value: object) -> bool:
    """Return whether a block looks like one camera of a Kalibr camchain."""
    return isinstance(value, dict) and ("intrinsics" in value or "camera_model" in value)


def _from_ros(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the camera of a ROS camera_info file."""
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
    return replace(camera, covariance=covariance, photographs=recorded)


def _covariance(entry: CalibratedEntry, camera: Camera, path: Path) -> Array | None:
    """Return the covariance of all intrinsics, None where only standard deviations are stated."""
    intrinsics, names, rows = intrinsic_names(camera), entry.names, entry.covariance
    for key, listed in (("sigma", list(entry.sigma)), ("names", names or [])):
        unknown = [name for name in listed if name not in intrinsics]
        twice = sorted({name for name in listed if listed.count(name) > 1})
        if unknown or twice:
            wrong_names = ", ".join(unknown) or f"{', '.join(twice)} twice"
            raise DatasetError(
                f"{path}: legcal_camera.{key} could not be used: found {wrong_names}, needed "
                f"names of {camera.model}: {', '.join(intrinsics)}; calibrate the camera again."
            )
    if names is None and rows is None:
        return None
    problem = _covariance_problem(names, rows, entry.sigma)
    if problem:
        raise DatasetError(
            f"{path}: legcal_camera.covariance could not be used: found {problem}; calibrate the "
            "camera again."
        )
    covariance, indices = (
        np.zeros((len(intrinsics), len(intrinsics))),
        [intrinsics.index(n) for n in names or ()],
    )
    C = np.array(rows).reshape(len(indices), len(indices))
    covariance[np.ix_(indices, indices)] = 0.5 * (C + C.T)
    return covariance


def _covariance_problem(
    names: Sequence[str] | None, rows: Sequence[Sequence[float]] | None, sigma: Mapping[str, float]
) -> str:
    """Return the actual and the needed content of an invalid covariance, in words; "" if valid."""
    if names is None or rows is None:
        missing, present = ("names", "covariance") if names is None else ("covariance", "names")
        return f"{present} without {missing}, needed both"
    n = len(names)
    if len(rows) != n or any(len(row) != n for row in rows):
        lengths = "rows of other lengths" if len(rows) == n else f"{len(rows)} rows"
        return f"{lengths}, needed {n} rows of {n} numbers for {', '.join(names)}"
    C = np.array(rows).reshape(n, n)
    if not np.all(np.isfinite(C)):
        return "a number that is not finite, needed variances and covariances"
    variance = np.diagonal(C)
    least, most = _SIGMAS
    possible = (variance == 0.0) | ((variance >= least**2) & (variance <= most**2))
    if not possible.all():
        i = int(np.argmin(possible))
        return (
            f"the variance {variance[i]:g} of {names[i]}, needed zero or the square of a standard "
            f"deviation of {least:g} to {most:g}"
        )
    root = np.sqrt(np.where(variance > 0.0, variance, 1.0))
    if np.any(np.abs(C) > (1.0 + _ROUNDING) * np.outer(root, root)):
        return "a matrix that is not positive semidefinite, needed one that is"
    correlation = C / np.outer(root, root)
    if np.abs(correlation - correlation.T).max(initial=0.0) > _ROUNDING:
        return "a matrix that is not symmetric, needed one that is"
    exact = variance == 0.0
    least_value = float(np.linalg.eigvalsh(correlation)[0]) if n else 0.0
    if correlation[exact].any() or least_value < -_ROUNDING:
        return "a matrix that is not positive semidefinite, needed one that is"
    for name, s in zip(names, np.sqrt(variance).tolist(), strict=True):
        if name in sigma and abs(sigma[name] - s) > _SIGMA_DIGITS * s:
            return f"a standard deviation {s:g} of {name} in it, needed {sigma[name]:g} as in sigma"
    return ""


def _from_opencv(document: Mapping[str, Any], path: Path) -> Camera:
    """Return the camera of an OpenCV FileStorage, with the model by the number of coefficients."""
    entry = validate(OpenCVEntry, document, path)
    coefficients = entry.distortion_coefficients.data
    model: DistortionModel = "plumb_bob"
    if entry.fisheye_model:
        model = "equidistant"
    elif len(coefficients) > 5:
        model = "rational_polynomial"
    K = _matrix(entry.camera_matrix)
    return _checked(path, K, (entry.image_width, entry.image_height), model, coefficients)


def _from_kalibr(document: Mapping[str, Any], cameras: Sequence[str], path: Path) -> Camera:
    """Return the only camera of a Kalibr camchain."""
    if len(cameras) > 1:
        raise DatasetError(
            f"{path}: the camera file could not be used: found {len(cameras)} cameras "
            f"({', '.join(cameras)}), needed one camera a file; copy each camera into a file of "
            "its own and name that file in its view."
        )
    prefix = cameras[0] if cameras else ""
    entry = validate(KalibrEntry, document[prefix] if cameras else document, path, prefix)
    fx, fy, cx, cy = entry.intrinsics
    model = next(m for m, d in DISTORTION_MODELS.items() if entry.distortion_model in d.kalibr)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    coefficients = entry.distortion_coeffs
    problems = []
    needed = 0 if entry.distortion_model == "none" else 4
    if len(coefficients) != needed and (needed or any(coefficients)):
        problems.append(_wrong_count(path, entry.distortion_model, len(coefficients), str(needed)))
        coefficients = [0.0] * needed
    return _checked(path, K, entry.resolution, model, coefficients if needed else [], problems)


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
            return {name: _node_value(node) for name, node in nodes.items()}
    except UnicodeDecodeError:
        reason = "bytes that are not UTF-8 text"
    except (cv2.error, SystemError):
        pass
    raise DatasetError(
        f"{path}: the camera file could not be read: found {reason}, needed an OpenCV FileStorage "
        "in YAML, XML or JSON; write it again with cv2.FileStorage."
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
    return (
        f"{path}: the distortion could not be used: found {n_coefficients} coefficients, needed "
        f"{needed} for {model}; copy all of them from the calibration."
    )


def _checked(
    path: Path,
    K: Array,
    size: tuple[int, int],
    model: DistortionModel,
    coefficients: Sequence[float],
    problems: Sequence[str] = (),
) -> Camera:
    """Return a camera; refuse numbers that no camera has."""
    problems = list(problems)
    distortion = np.array(coefficients, dtype=np.float64)
    if model == "rational_polynomial" and len(distortion) in (12, 14) and not distortion[8:].any():
        distortion = distortion[:8]  # OpenCV pads with the thin prism and tilt that it did not fit
    counts = DISTORTION_MODELS[model].counts
    if len(distortion) not in counts:
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
    return Camera(K, size[0], size[1], distortion, model)


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
        if focal == 0.0 or abs(focal) < _SINGULAR * extent:
            problems.append(
                f"{start} {name} = {focal:g}, so that it is singular, needed a focal length above "
                "0 px; copy it from the calibration."
            )
        elif focal < 0.0:
            problems.append(
                f"{start} {name} = {focal:g}, needed a focal length above 0 px; write the matrix "
                "for x to the right and y down."
            )
    for name, centre, extent in (("cx", K[0, 2], size[0]), ("cy", K[1, 2], size[1])):
        if not -0.5 <= centre <= extent - 0.5:
            problems.append(
                f"{start} {name} = {centre:g}, needed a principal point inside the image of "
                f"{size[0]} x {size[1]} px; calibrate at the size of the images."
            )
    return problems


def camera_info(camera: Camera, name: str, more: Mapping[str, Any] | None = None) -> str:
    """Return the text of a ROS camera_info file that reads back as the same camera."""
    distortion = camera.distortion if len(camera.distortion) else np.zeros(5)
    projection = np.column_stack([camera.K, np.zeros(3)])
    document = {
        "image_width": camera.width,
        "image_height": camera.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": camera.K.ravel().tolist()},
        "distortion_model": camera.model,
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
