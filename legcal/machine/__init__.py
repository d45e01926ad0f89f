"""Section 2: a parallel machine from its files, and the equations of its legs at poses.

Inputs are mechanism YAMLs with a URDF, URDFs with loops and MJCF files; the output is a
:class:`Machine`: legs, joint frames R_b and R_e, mobility, a closed home, and the chain in
Pinocchio. A :class:`Leg` holds its joints and the numbers of its equations, which follow from its
joints (:class:`JointType`). :class:`Parametrization` maps the numbers to the parameter vector, with
names, units and gauge. :func:`pose_equations` has derivatives by pose and by parameters, and is
compared with Pinocchio whenever a machine is loaded. Poses and closed chains have one solver
(:func:`solve_poses`, :func:`forward_kinematics_many`), random configurations one sampler
(:func:`random_configurations`). Calibrated models are written as patches of the files read.
"""
