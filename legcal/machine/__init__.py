"""Section 2: a parallel machine from its files, and what its legs demand of poses.

In come mechanism YAMLs with a URDF, URDFs with loops of their own, MJCF files and tables of joints;
out comes a :class:`Machine`: legs, joint frames R_b and R_e, mobility, a closed home, and the
chain in Pinocchio. A :class:`Leg` holds the numbers of its equations; :class:`Parametrization` says
where they stand in the parameter vector, with names, units and gauge; :func:`pose_equations` is all
that legs demand of poses, with derivatives by the pose and by the parameters, and is checked
against Pinocchio whenever a machine is loaded. Poses and closed chains have one solver
(:func:`solve_poses`, :func:`forward_kinematics_many`), random configurations one sampler
(:func:`random_configurations`). Calibrated models are written as patches of the files read.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
