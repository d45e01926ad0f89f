"""Names of distortion models and camera files for options of commands, without heavy imports."""

from typing import Literal

DistortionModel = Literal[
    "plumb_bob", "rational_polynomial", "thin_prism", "equidistant", "splined_radial"
]
CameraProgram = Literal["ros", "opencv", "kalibr", "mrcal"]
