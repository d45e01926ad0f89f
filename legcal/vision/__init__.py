"""Cameras and what they see of a cylinder (section 3.1).

Camera files and images in; :class:`Camera`, boards and their corners out; the outlines of a
cylinder, eqs (1) to (5); which parts of which legs are in view, and what hides them.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
