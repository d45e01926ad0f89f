"""A machine in a browser, as it moves: ``legcal view``.

In comes a model, a result or a dataset (:func:`open_source`). :class:`Motion` is where the machine
stands, moved by readings (closed-loop kinematics) or by the platform's own coordinates;
:class:`Stage` says what is seen of it there, numbers in, numbers out; :class:`Photographs` are
cameras, their images without distortion, and outlines in space. :class:`Window` alone knows the
browser: it shows them with viser, an extra.
"""
