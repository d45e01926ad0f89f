"""The numbers on which recognition and measurement depend most.

Lengths are parts of the mean leg length, distances in images pixels, everything else a share or a
number of standard deviations. Chains of tolerances and thresholds of one kind are made from one
number, here or beside the code that uses them. ``benchmarks/constants.py`` multiplies each of them
and calibrates small sessions.
"""

# Recognition: edge pairs, and camera poses by them

# Of an edge in the reduced picture, at least [reduced px].
EDGE_LENGTH = 14.0
# Slopes of an edge in those of the median pixel, from which on it is no noise.
EDGE_SLOPE = 2.5
# Of the width of an edge pair and of that of its leg: relative, one standard deviation.
WIDTH_ERROR = 0.08
# Of an axis beside its edge pair where a search of cameras begins [leg lengths].
AXIS_TOLERANCE = 0.12
# Of the joints of the nominal model, one standard deviation [leg lengths].
JOINT_ERROR = 0.015
# Of the legs that a picture should show: the share that accepts a camera pose.
SUPPORT = 0.2
# Of the best camera pose over the next one, in legs of all images together.
LEAD = 0.6
# Of the evidence of outlines for a camera pose over that for another one.
EVIDENCE_RATIO = 1.6
# Of outlines for a camera pose, at least: halves of squared standard deviations.
EVIDENCE = 8.0
# Of a leg in an image from the fit of its view, beyond which it is left out [standard deviations].
OUTLIER_SIGMAS = 3.5
# Of the outlines that other images of a view show: an image with a smaller share is wrong.
SHARE_OF_OTHERS = 0.5

# Measurement: outlines near a camera pose

# Around a predicted outline besides what errors of joints make, in which it is looked for [px].
WINDOW_PX = 3.0
# Mean sharpness of the blocks of an edge of a pair, from 0 to 1, at least.
EDGE_SCORE = 0.15
# Of the score of an edge, which no other line near it may reach where it stands alone.
RIVAL = 0.6
# Step of light at an outline [grey levels], at least.
CONTRAST = 4.0
# Of the blocks of an edge from its line, one standard deviation at most [px].
SCATTER_PX = 0.6
# Of the blocks that show an edge, the share that lies on its line.
INLIER_SHARE = 0.6
# Of the distance of two outlines from the predicted width [px], beside 3.5 % of it.
WIDTH_PX = 0.7
# Width of the biweight by which blocks of a line are weighted [standard deviations].
BLOCK_SIGMAS = 4.0
# Of an outline: what its covariance leaves out where views are fitted, as a wrong gamma [px].
OUTLINE_SIGMA_PX = 0.3

# Of axes beside edge pairs, all made from AXIS_TOLERANCE [leg lengths]: from where a search of
# cameras begins to where poses are known,
_WIDENED = AXIS_TOLERANCE / 0.12
SEARCHING = tuple(_WIDENED * x for x in (0.12, 0.085, 0.06, 0.044, 0.03, 0.02, 0.015))
# and from there, with joints where images see them, to where poses are compared.
FITTING = tuple(_WIDENED * x for x in (0.024, 0.017, 0.012, 0.01, 0.0075))
