"""One estimation problem for everything: variables, factors, one solver, information.

Every estimate from measurements is the minimum of an :class:`EstimationProblem`; this room knows
neither images nor robots (:mod:`legcal.calibration.joint_fit` is its largest client):

**State** A dataclass of the client with one field for each block of variables, of any type.

**Variables** A block: elements of one manifold. ``unknown`` (n, d) is the index of the unknown that
moves each of the d coordinates of each element: -1 is fixed (gauge, or by choice), equal indices
share one unknown (views that share a lens). ``retract`` applies a tangent step (a sum,
``Frames.moved``, or a function of the client). ``labels`` and ``units`` name the unknowns that are
reported, ``coordinates`` and ``jacobian`` map x to the reported values where these differ,
``prior`` is a Gaussian on them, correlated or not.

**Factor** Measurements of one kind: ``rows(state)`` returns the residuals of all measurements with
their derivatives by the blocks named in ``touches``, in that order, and by the eliminated
``element``; ``whitening`` makes them unit Gaussians, ``robust`` applies the loss to them.

**EstimationProblem** Kept variables, one block of eliminated variables (platform poses, board
poses: each measurement touches at most one of them, and the Schur complement removes them),
factors, an exact ``constraint`` on the eliminated elements, and ``held_directions`` of the kept
unknowns that are fixed.

::

    problem = EstimationProblem((camera,), board_poses, (corners,))
    minimum = minimise(problem, state, Huber(3.0))  # Levenberg-Marquardt, loss narrowed on the way
    normal = information(minimum.linear)
    covariance = named_covariance(minimum.linear, normal.kept_covariance())

A client writes a state, a function of residual rows for each kind of measurement (analytic
derivatives; one finite-difference test checks them all), and the blocks. At predicted observations
the same :func:`information` gives the Cramer-Rao bound and the identifiable parameters; it is
additive over eliminated elements, so that candidate images are low-rank updates of it
(``NormalEquations.contributions``). Rank decisions use its square root (``marginal_rows``).
The same matrix gives the response to errors of fixed quantities (:func:`response`), the
disagreement between eliminated elements with common errors (:class:`Clusters`), score tests of
columns that were not fitted (:func:`score_test`, :func:`scores_of_block`), and the covariance of
predictions (:func:`leverage`). Variances of random effects are estimated by restricted
maximum likelihood (:class:`Effects`).
"""
