"""The numbers on which the joint fit and its uncertainty depend most.

Lengths are parts of the mean leg length; distances of outlines are in their standard deviations.
``benchmarks/constants.py --room calibration`` multiplies each number and calibrates small sessions.
"""

# Priors: standard deviations

# Of a radius, as a part of it.
RADIUS_SIGMA = 0.02
# Of the direction of an arm [rad], and of its position across [mean rod lengths].
ARM_AXIS_SIGMA = 0.02
ARM_POINT_SIGMA = 0.01
# Of the direction of a body against the line of its joints [rad]: joint centres lie within some
# tenths of a millimetre of the axis of a part half a metre long.
LEAN_SIGMA = 5e-4
# Of the twist of a leg about its nominal one [deg].
TWIST_SIGMA_DEG = 1.0
# Of all kinematic parameters about the nominal model, while the first minimum is searched.
FIRST_MINIMUM_SIGMA = 0.1
# Of ln gamma: photographs are linear, or near 2.2.
GAMMA_SIGMA = 0.5

# Outliers

# Width of the robust loss, where it turns from quadratic to linear.
LOSS_WIDTH = 3.0
# Distance at which an outline is rejected; false for one outline in 25,000.
REJECTION = 4.5
# Half-width of the transition of weights there, as a part of that distance.
REJECTION_TAPER = 0.2
# Cost of the outlines of a pose over the median, above which another pose is searched.
OUTLIER_POSE_COST = 10.0

# Errors that outlines share

# Bias of all edges of a camera by light at the limb and blur, where a scale depends on it [px].
EDGE_BIAS_PX = 0.1
# The same in photographs, at least: light at the limb looks like other radii, so that residuals
# never show it [px].
LIMB_BIAS_PX = 0.02
# Bias and tilt of a leg in a view over those of its single outlines, at least: light that shifts an
# edge stands still. In photographs by two renderers with truth they are 0.7 to 1.4 and 0.2 to 0.8.
LIMB_SHARES = (0.5, 0.3)
# Error of an edge of a body that it keeps in all images of a view, over that of a single one: with
# less, three sessions of electric cylinders by another renderer end farther off than is stated.
EDGE_SHARE = 1.0
# Bias of an edge of a polished part at a place, where it reflects much the same in all poses [px]:
# in photographs of chromed and polished rods with truth, means of an edge in a view scatter by it.
POLISHED_BIAS_PX = 0.2
# Gain of log likelihood above which a common-mode bias is estimated: one set of white residuals in
# ten to twenty gains that much.
MIN_BIAS_GAIN = 6.0
# Errors at the limb that look like another gamma, one standard deviation of its logarithm: from
# rendered photographs of machines with a known gamma.
LIMB_GAMMA_SIGMA = 0.17

# Directions that the data do not determine

# Standard deviation of a parameter above which a direction is undetermined.
MAX_SIGMA = 0.1
# The same for a direction that hardly moves the platform: it is held at nominal.
HELD_SIGMA = 0.01
# Motion of the platform over the change of parameters, below which it hardly moves.
HARMLESS = 0.01

# Doubts in a result

# Probability with which a kind of test doubts a healthy session by chance, all that it asks
# together: scans over moments and motors, witnesses of the scale, scatter of views and legs.
DOUBT_BY_CHANCE, SCALE_BY_CHANCE, SCATTER_BY_CHANCE = 1e-4, 0.0027, 1e-3
