"""Exports: a machine, or a result with what is known of it, in the formats of other programs.

In comes a :class:`Subject`, a mechanism or a result folder that :func:`load_subject` read; out come
files, which :func:`export` writes all of them or none. ``FORMATS`` is the one table of formats,
each a function of a subject. A format that the machine's class does not have is refused with those
that it has. Lengths are metres and angles radians in files that
programs compute with (``urdf``, ``mjcf``, ``python``, ``c``, ``matlab``), millimetres and degrees
in those that people and controllers read (``table``, ``csv``, ``json``, ``linuxcnc``,
``correction``).
"""
