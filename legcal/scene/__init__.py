"""The visible geometry of a machine, for the page of a calibration and the viewer.

Inputs are a machine, the document of a calibration and cameras; outputs are points and lengths [m]
in the base link: joints at readings, the change by a calibration and weak directions as motions,
ellipsoids of joints, view pyramids of cameras. Drawing is done elsewhere: by ``scene.js`` of
:mod:`legcal.pages` on the canvas of a page: a report, or that of :mod:`legcal.viewer`.
"""
