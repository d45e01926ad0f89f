"""What the four steps minimise: the choices that commands offer, without anything heavy."""

from typing import Literal

Criteria = Literal["default", "literal"]  # legcal's criteria, or the paper's as printed
Transformation = Literal["points", "cross_product"]  # (18) by point equality, or as printed
