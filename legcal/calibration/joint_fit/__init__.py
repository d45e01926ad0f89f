"""The joint fit of a machine: all outlines (or axes), readings and corners of a board at once.

The client of :mod:`legcal.estimation` for legs and images. In: :class:`FittedLegs`, measurements,
outlines or axes, a :class:`Start`, :class:`Choices`; out: a :class:`Solution`. :func:`refine` reads
as the method: a first minimum with a wide loss, open directions held at nominal or refused, rounds
that reject outlines and estimate their noise, the result judged and put together.

=================== ==================================================================
``state``           what the fit moves: legs, radii, intrinsics, biases, cameras, poses
``parameters``      which parameters are estimated, fixed or known
``observations``    measurements as arrays
``factors``         residuals with derivatives: outlines, readings, axes, corners
``poses``           exact constraints of platform poses, starting poses
``problem``         the blocks of variables and the factors of a fit
``edge_biases``     common-mode errors of outlines, ``gammas`` of cameras
``determinacy``     open directions: refused, or held at nominal
``rounds``          rejection of outliers and estimation of noise
``contradictions``  stated priors and fixed values against the measurements
``sensitivity``     mistakes in what counts as known; focal lengths tested
``held_out``        what a fit predicts of images that it has not seen
``platform``        what a fit means at the platform
``fit``             the order of all of it
``solution``        the result
=================== ==================================================================
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
