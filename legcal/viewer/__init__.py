"""A machine in a browser, as it moves: ``legcal view``.

The input is a model, a result or a dataset (:func:`open_source`). :class:`Motion` holds the posture
of the machine, moved by readings (closed-loop kinematics) or by independent coordinates of the
platform; :class:`Stage` computes the visible geometry at a posture; :class:`Photographs` holds
cameras, their undistorted images, and outlines in space. Only :class:`Window` depends on the
browser: it shows them with viser, an extra.
"""
