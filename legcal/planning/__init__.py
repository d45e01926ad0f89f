"""Plan a session before it is shot: poses and camera places that determine the machine best.

In: a mechanism, a camera, what is known of the errors of outlines; out: a :class:`Plan`, and the
folder of a session. :func:`plan` reads what is asked, ``planner`` is the method in order. The paper
ends on it: "a better selection of the end-effector poses".

==================== ===================================================================
``request``          what is asked, checked; the fewest images that reach a target
``planner``          poses, places, images chosen, exchanged, polished, judged
``poses``            poses that the machine takes, however far it is off
``places``           where cameras may stand, and how well they are set
``sight``            what a camera sees of legs: rays past other legs and plates
``information``      rows that images add to the information of the joint fit
``exchange``         greedy choice and exchanges by low-rank updates of the covariance
``goals``            what is made small
``order``            the order of poses and the ways between them
``laid_board``       where a board lies, and which images show it
``noise``            errors of outlines from earlier results
``planned_session``  the plan and its document
``session``          its folder
==================== ===================================================================
"""
