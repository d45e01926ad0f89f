"""The paper's method in section 3: four steps from leg axes to parameters.

In go a :class:`NominalMachine` (the start of the steps), the leg axes from the images (section 3.1,
packages vision and data) and the readings; out come the identified legs and the cameras.

=====================  =======  ==================================================================
``conditions``         3.2-3.5  counts of equations and unknowns as printed, (10)-(12), (15), (17)
``equations``          3.2-3.5  (6) to (19), each as one CasADi expression
``joints_in_camera``   3.2      step 1: base joints and revolute axes in each camera, (6), (7)
``joints_in_base``     3.3      step 2: the same in R_b, and the camera poses, (8), (9)
``offsets``            3.4      step 3: offsets of the legs, (13), (14)
``platform``           3.5      step 4: joints and axes on the platform, passive legs, (16)-(19)
``four_steps``         3        the steps in a row
``unknowns``           -        the machine and the unknowns of a step; weak directions
``least_squares``      -        the sum of squares of some of them, minimised by IPOPT
=====================  =======  ==================================================================

Criteria choose the weights: all one (``literal``, as printed), or from the covariances of the axes,
with which (18) locates joints and offsets as well. Errors of the platform (20) are computed by
``pose_differences`` of the package machine.
"""
