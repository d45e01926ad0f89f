"""The numbers on which recognition and measurement depend most.

Lengths are parts of the mean leg length, distances in images pixels, everything else a share or a
number of standard deviations. Chains of tolerances and thresholds of one kind are made from one
number, here or beside the code that uses them. ``benchmarks/constants.py`` multiplies each of them
and calibrates small sessions.
"""

# Recognition: edge pairs, and camera poses by them

# Minimum length of an edge in the reduced image [reduced px].
EDGE_LENGTH = 14.0
# Minimum slope of an edge, over the slope of the median pixel.
EDGE_SLOPE = 2.5
# Relative difference of the widths of an edge pair and its leg, one standard deviation.
WIDTH_ERROR = 0.08
# Distance of an axis from its edge pair at the start of a camera search [leg lengths].
AXIS_TOLERANCE = 0.12
# Error of the joints of the nominal model, one standard deviation [leg lengths].
JOINT_ERROR = 0.015
# Share of the predicted legs that accepts a camera pose.
SUPPORT = 0.2
# Lead of the best camera pose over the next one, in legs of all images together.
LEAD = 0.6
# Ratio of the evidence of outlines for the best camera pose and for the next one.
EVIDENCE_RATIO = 1.6
# Minimum evidence of outlines for a camera pose: halves of squared standard deviations.
EVIDENCE = 8.0
# Distance of a leg in an image from the fit of its view: rejected beyond [standard deviations].
OUTLIER_SIGMAS = 3.5
# Share of outlines over the share in other images of a view: below, an image is wrong.
SHARE_OF_OTHERS = 0.5

# Measurement: outlines near a camera pose

# Search window around a predicted outline, in addition to errors of joints [px].
WINDOW_PX = 3.0
# Minimum mean sharpness of the blocks of an edge of a pair, from 0 to 1.
EDGE_SCORE = 0.15
# Part of the score of a single edge that no other line near it may reach.
RIVAL = 0.6
# Minimum step of light at an outline [grey levels].
CONTRAST = 4.0
# Maximum scatter of the blocks of an edge about its line, one standard deviation [px].
SCATTER_PX = 0.6
# Minimum share of the blocks of an edge on its line.
INLIER_SHARE = 0.6
# Tolerance of the width between two outlines [px], in addition to 3.5 % of it.
WIDTH_PX = 0.7
# Width of the biweight of the blocks of a line [standard deviations].
BLOCK_SIGMAS = 4.0
# Error of outlines beyond their covariance in fits of views, such as a wrong gamma [px].
OUTLINE_SIGMA_PX = 0.3

# Of axes beside edge pairs, all made from AXIS_TOLERANCE [leg lengths]: from where a search of
# cameras begins to where poses are known,
_WIDENED = AXIS_TOLERANCE / 0.12
SEARCHING = tuple(_WIDENED * x for x in (0.12, 0.085, 0.06, 0.044, 0.03, 0.02, 0.015))
# and from there, with joints where images see them, to where poses are compared.
FITTING = tuple(_WIDENED * x for x in (0.024, 0.017, 0.012, 0.01, 0.0075))
