"""Names of distortion models: what commands offer, without anything heavy."""

from typing import Literal

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]
