"""Photographs to outlines: recognition, measurement, diagnostics and overlays (section 3.1).

In go :class:`Photographs` (images, the model, which rows to search) and a nominal
:class:`Placement` (rough cameras, joint centres by the model). :func:`place_and_measure` recognises
the legs, places the cameras, measures and looks again: out come a Placement,
:class:`legcal.data.outlines.Outlines`
with covariance and verdict, and why images or views are left out. :func:`measure_photographs` does
the measurement alone near any Placement, as that of a joint fit (``Placement.of_fit``).

The seam inside is :func:`measure`: what one image should show in (:class:`ImageSearch`), all its
outlines with covariance and verdict out. Calibration boards (:func:`detect_corners`,
:func:`camera_poses_by_board`) and overlays (:func:`draw`) stand beside.
"""
