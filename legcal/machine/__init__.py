"""Section 2: a parallel machine from its files, and the equations of its legs at poses.

Inputs are mechanism YAMLs with a URDF, URDFs with loops and MJCF files; the output is a
:class:`Machine`: legs, joint frames R_b and R_e, mobility, a closed home, and the chain in
Pinocchio. What flows, each step in the modules named:

===============================  ===============================================
text to a tree, pairs of frames  files, urdf, mjcf, spanning_tree, formats
bodies and chains between them   chain, topology
a chain to a leg                 classification, leg, actuator, rods
legs to a checked machine        loader, home, shapes, origins, model
numbers to a parameter vector    parameters, ties, tolerance
equations with derivatives       equations
poses, readings, closed chains   chain, solver, closing, kinematics, redundancy
random poses of the workspace    configurations
a machine to people and files    inspection, picture, model_writer
===============================  ===============================================

A joint of the tree, or a ``3d`` closure, between two bodies is a :class:`Connection`; those at one
end of a leg are a :class:`Pivot` of a :class:`JointType`, from which the equations of a
:class:`Leg` follow. :func:`pose_equations` is compared with Pinocchio whenever a machine is
loaded. Calibrated URDFs are written as patches of the file read.
"""
