"""Rotations, rigid motions, lines and covariances, batched along the leading axes; numpy alone.

The sign of eq (1) is defined here only: the moment of a line is u x M. No robots, no cameras.
"""
