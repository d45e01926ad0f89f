"""Cameras and the image of a cylinder (section 3.1).

Camera files and images in; :class:`Camera`, boards and their corners out; the outlines of a
cylinder, eqs (1) to (5); the visible parts of legs, with occlusion.
"""
