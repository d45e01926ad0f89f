"""What is seen of a machine in space, on the page of a calibration and in the viewer.

In come a machine, the document of a calibration and cameras; out come points and lengths [m] in the
base link: joints at readings, what a calibration changed and weak directions as motions, ellipsoids
of joints, pyramids of what cameras see. How they are drawn is said elsewhere.
"""
