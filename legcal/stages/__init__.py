"""Sections 3.2 to 3.5: the four steps, one file a step.

``run.run_steps`` takes them in a row: ``locate_joints_in_cameras`` (3.2) and
``locate_joints_in_base`` (3.3), which are ``run_base_steps``, then ``identify_offsets`` (3.4) and
``locate_platform_joints`` (3.5), which are ``run_platform_steps``.
"""
