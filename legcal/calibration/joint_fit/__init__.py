"""The joint fit of a machine: all outlines (or axes), readings and corners of a board at once.

The client of :mod:`legcal.estimation` for legs and images. In: :class:`FittedLegs`, measurements,
outlines or axes, a :class:`Start`, :class:`Choices`; out: a :class:`Solution`. :func:`refine` reads
as the method: a first minimum with a wide loss, open directions held at nominal or refused, rounds
that reject outlines and estimate their noise, checks of the result, its assembly.

===================== ==================================================================
``parameter_choices`` which parameters are estimated, fixed or have a prior
``variables``         state, manifold of the legs, exact constraints of platform poses
``factors``           outlines, readings, axes and corners as residuals with derivatives
``outline_errors``    noise of outlines, common-mode edge biases, gammas of cameras
``gammas``            fits to outlines measured with several gammas, compared
``problem``           variables and factors of a fit
``fit``               the order of all of it
``determinacy``       open directions: refused, or held at nominal
``rounds``            rejection of outliers and estimation of noise
``outlier_readings``  wrong readings of redundant motors: found and left out
``diagnostics``       stated priors and fixed values against the measurements
``scale``             what says how large a machine is: a measured length, or radii alone
``sensitivity``       errors of what counts as known; focal lengths tested
``held_out``          what a fit predicts of images that were not fitted
``platform``          what a fit means at the platform
``solution``          the result
===================== ==================================================================

Another kind of measurement is a class with a ``factor`` in ``factors`` and a line in its registry
``Observed``; what it depends on besides is a field of ``State`` and a block in ``problem``.
"""
