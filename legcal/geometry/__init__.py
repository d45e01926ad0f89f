"""Rotations, rigid motions, lines and covariances, batched along the leading axes; numpy alone.

The one place of the sign of eq (1): the moment of a line is u x M. No robot and no camera.
"""
