"""The weights of the four steps: the choice that commands offer, without anything heavy."""

from typing import Literal

Criteria = Literal["default", "literal"]  # from the covariances of the axes, or all one
