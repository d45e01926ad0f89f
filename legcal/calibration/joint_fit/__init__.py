"""The joint fit of a machine: all outlines (or axes), readings and corners of a board at once.

The client of :mod:`legcal.estimation` for legs and images. In: :class:`FittedLegs`, measurements,
outlines or axes, a :class:`Start`, :class:`Choices`; out: a :class:`Solution`. :func:`refine` is
the method from top to bottom: a first minimum with a wide loss, unobservable directions held at
nominal or refused, rounds of outlier rejection and noise estimation, checks, the result.

===================== ==================================================================
``parameter_choices`` which parameters are estimated, fixed or have a prior
``variables``         state, manifold of the legs, exact constraints of platform poses
``factors``           outlines, readings, axes and corners as residuals with derivatives
``outline_errors``    noise of outlines, common-mode edge biases, gammas of cameras
``problem``           variables and factors of a fit
``fit``               the whole fit, step by step
``determinacy``       unobservable directions: refused, or held at nominal
``rounds``            rejection of outliers and estimation of noise
``outlier_readings``  wrong readings of redundant motors: detected and rejected
``diagnostics``       stated priors and fixed values against the measurements
``scale``             the source of the absolute scale: a measured length, or radii alone
``sensitivity``       score tests of cameras; what wrong ones do to the parameters
``held_out``          prediction errors in held-out images, and in images left out in turn
``platform``          accuracy at the platform
``predicted``         the information and noise of images before they are measured
``solution``          the result
===================== ==================================================================

To add a kind of measurement: a class with a ``factor`` in ``factors``, a field of ``Observed``,
and for each new variable a field of ``State`` and a block in ``problem``.
"""
