"""One estimation problem for everything: variables, factors, one solver, information.

Every estimate from measurements is the minimum of a :class:`Problem`; this room knows neither
images nor robots (:mod:`legcal.calibration.joint_fit` is its largest client):

**State** A dataclass of the client with one field for each block of variables, of any type.

**Variables** A block: elements of one manifold. ``unknown`` (n, d) says which unknown moves each of
the d numbers of each element: -1 is fixed (gauge, or by choice), equal numbers move
together (views that share a lens). ``retract`` applies changes (a sum, ``Frames.moved``, or
the client's own). ``labels`` and ``units`` name unknowns that are reported, ``coordinates`` and
``jacobian`` map x to reported values where these differ, ``prior`` is a Gaussian on them, with
correlations where these are known.

**Factor** Measurements of one kind: ``rows(state)`` returns residuals of all of them at once with
their derivatives by the blocks that ``touches`` names, in that order, and by the eliminated
``element``; ``whitening`` makes them unit Gaussians, ``robust`` puts the loss on them.

**Problem** Kept variables, one block of eliminated ones (platform poses, boards in images: each
measurement touches one of them at most, and the Schur complement removes them), factors, an exact
``constraint`` on the eliminated elements, and ``held_directions`` that may not move.

::

    problem = Problem((camera,), board_poses, (corners,))
    found = minimise(problem, state, Huber(3.0))  # Levenberg-Marquardt, loss narrowed on the way
    normal = information(problem, found.state, found.linear)
    covariance = named_covariance(problem, found.state, normal.kept_covariance())

A client writes a state, a function of rows for each kind of measurement (derivatives written out;
one test of finite differences checks them all), and the blocks. At predicted observations the same
:func:`information` is the Cramer-Rao bound and says what is identifiable; it is additive over
eliminated elements, so that candidate images are low-rank updates of it
(``NormalEquations.contributions``). Where ranks are decided, :func:`information_rows` keeps its
square root. The response to errors of what is fixed (:func:`response`),
what eliminated elements that share errors disagree by (:class:`Clusters`),
score tests of columns that were not fitted (:func:`score_test`, :func:`scores_of_block`), and the
covariance of predictions (:func:`explained_share`) come from the same matrix. Variances of random
effects are estimated by restricted maximum likelihood (:class:`Effects`).
"""
