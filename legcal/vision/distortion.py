"""Names of distortion models for options of commands, without heavy imports."""

from typing import Literal

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
