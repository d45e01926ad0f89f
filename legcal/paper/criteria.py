"""The weights of the four steps: the choices for options of commands, without heavy imports."""

from typing import Literal

Criteria = Literal["default", "literal"]  # from the covariances of the axes, or all one
