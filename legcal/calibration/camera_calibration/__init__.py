"""A camera from photographs of a flat board: `calibration` is the job.

Corners are searched, the camera and the board in every image are adjusted to them (`adjustment`)
and diagnosed (`diagnostics`); `document` holds the result and writes it.
"""
