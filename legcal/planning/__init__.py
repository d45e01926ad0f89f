"""Plan a session: poses and camera places that determine the machine best (optimal design).

In: a mechanism, a camera, and the noise of outlines; the information of images of the joint fit
(``calibration.joint_fit.predicted``); out: a :class:`Plan`, and the folder of a
session. :func:`plan` checks the request, ``planner`` is the method from top to bottom. The paper
names it as future work: "a better selection of the end-effector poses".

============ ===========================================================================
``request``  options and their checks; the fewest images for a target error
``planner``  poses, places and images: selection, exchange, local search, evaluation
``poses``    poses within reach for all machines within tolerance; their order
``places``   camera places, tolerances of tripods, place of a board
``exchange`` greedy selection and exchanges by low-rank updates of the covariance
``session``  the plan, its document, the folder of a planned session
============ ===========================================================================
"""
