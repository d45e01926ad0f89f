"""The joint fit of legs, cameras and platform poses to outlines, axes, readings and corners."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
