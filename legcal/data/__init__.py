"""The dataset folder (section 4.1): read, checked and put into canonical order.

A folder in; a :class:`Dataset` out, with its :class:`Measurements` and the tables of what images
show (:class:`Outlines`, :class:`LegAxes`, :class:`Corners`), which are written here too.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
