"""Cameras and what they see of a cylinder (section 3.1).

Camera files and images in; :class:`Camera`, boards and their corners out; the outlines of a
cylinder, eqs (1) to (5); which parts of which legs are in view, and what hides them.
"""
