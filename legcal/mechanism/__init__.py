"""Section 2: the mechanism, from URDF and closures to legs, and its kinematics."""
