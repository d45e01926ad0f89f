"""Exports: a machine, or a result with its uncertainty, in the formats of other programs.

The input is a :class:`Subject`, a mechanism or a result folder read by :func:`load_subject`; the
output is files, which :func:`export` writes completely or not at all. ``FORMATS`` is the table of
formats, each a function of a subject. A format that does not support the type of machine is refused
with a list of those that do. Lengths are metres and angles radians in files for programs (``urdf``,
``mjcf``, ``python``, ``c``, ``matlab``), millimetres and degrees in files for people and
controllers (``table``, ``csv``, ``json``, ``linuxcnc``, ``correction``).
"""
