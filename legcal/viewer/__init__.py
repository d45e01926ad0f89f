"""A machine in a browser, as it moves: ``legcal view``; and the page for clicks on joints.

The input is a model, a result or a dataset (:func:`open_source`). :class:`Motion` holds the posture
of the machine, moved by readings (closed-loop kinematics) or by independent coordinates of the
platform; :class:`Photographs` holds cameras, images and outlines. The servers show them in pages
with the canvas of the report; :class:`PageServer` is what both have in common.
"""
