"""The dataset folder (section 4.1): read, checked and put into canonical order.

A folder in; a :class:`Dataset` out, with its :class:`Measurements` and the tables of observations
in images (:class:`Outlines`, :class:`LegAxes`, :class:`Corners`), which are written here too.
"""
