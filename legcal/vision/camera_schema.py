"""The schemas of the three kinds of camera files: ROS, OpenCV, Kalibr."""

from typing import Annotated, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from legcal.files.schema import FileSchema

Pixels = Annotated[int, Field(gt=0)]
Sigma = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
CALIBRATED = "legcal_camera"  # the key under which legcal camera says what it found


class _OpenSchema(FileSchema):
    """A block whose other keys belong to other programs."""

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


class CalibratedEntry(_OpenSchema):
    """What legcal adds to a camera that it calibrated: standard deviations by name."""

    version: Literal[1]
    sigma: dict[str, Sigma]


class RosEntry(_OpenSchema):
    """A ROS camera_info file."""

    image_width: Pixels
    image_height: Pixels
    camera_matrix: CameraMatrix
    distortion_model: Literal["plumb_bob", "rational_polynomial", "equidistant"] = "plumb_bob"
    distortion_coefficients: MatrixEntry
    legcal_camera: CalibratedEntry | None = None


class OpenCVEntry(_OpenSchema):
    """An OpenCV FileStorage, as its calibration sample writes it."""

    image_width: Pixels
    image_height: Pixels
    camera_matrix: CameraMatrix
    distortion_coefficients: MatrixEntry
    fisheye_model: int = 0


class KalibrEntry(_OpenSchema):
    """One camera of a Kalibr camchain."""

    camera_model: Literal["pinhole"]
    distortion_model: Literal["radtan", "equidistant", "none"]
    intrinsics: tuple[float, float, float, float]
    distortion_coeffs: list[float] = Field(default_factory=list)
    resolution: tuple[Pixels, Pixels]
