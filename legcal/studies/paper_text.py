"""What the paper prints, and how its text was read where it leaves a choice."""

AS_PRINTED = {
    "initial": {"dX_mm": 1.0, "dE_deg": 0.12},
    "calibrated": {"dX_mm": 0.08, "dE_deg": 0.018},
    "note": "Context only: the dimensions of the paper's machine are not published. It prints "
    "orientation errors of 0.12 and 0.018 rad; only degrees fit 1 and 0.08 mm.",
}
IN_DEGREES = (
    'Table 1 prints the standard deviations of psi and theta as "0.05 rad" and "0.06 rad": read '
    "as degrees. --radians takes them to the letter: the steps then end tens of millimetres off."
)
IN_RADIANS = (
    'Table 1 prints the standard deviations of psi and theta as "0.05 rad" and "0.06 rad": taken '
    "to the letter, as --radians asks."
)
READINGS = (
    "psi and theta are not defined: read as the tilt out of the image plane, asin(u_z), and the "
    "angle in the image, atan2(-u_x, u_y).",
    '"uniform noise with variance equal to 2mm" on the initial parameters: read as uniform '
    "within +-2 mm.",
    '"uniformly distributed noise, variance equal to 3um" on leg lengths: read as uniform within '
    "+-3 um, a standard deviation of 1.7 um; one reading for all images of a pose.",
    '"Fifteen end-effector poses": read as fifteen of each of the three camera positions, whose '
    "poses differ.",
    '"randomly selecting configurations with extreme leg lengths": every leg at random within '
    "12 % of its travel from its shortest or its longest, reached from home without a singularity.",
    '"three images are acquired" of each pose: each with its own noise.',
    '"ten randomly chosen poses" of (20): leg lengths uniform in the travel, drawn anew in every '
    "run.",
    "(20) as printed: dX is the displacement of B_1 from A_1, dE the norm of the x-y-z Euler "
    "angles of the rotation between both orientations.",
    "The machine: the shipped hexapod, whose joints are coplanar, and the same with joints 2, 4 "
    "and 6 moved 30 mm out of the planes of 1, 3 and 5; cameras stand 0.9 m from its middle.",
    "bound: the Cramer-Rao bound of the same data, all used at once; the table has the errors to "
    "be expected of an estimator that reaches it.",
)
