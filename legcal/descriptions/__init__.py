"""New models (``legcal new``): tables, configurations of controllers and families to model files.

Inputs are tables of joints in YAML or CSV, configurations of printers, hexapods and motion
simulators, or a few dimensions; the output is a YAML with its URDF (:func:`create_model`). All are
converted to one table, validated as a :class:`TableFile`; a :class:`Description` has its numbers in
metres. The kinematics that firmwares document are in :mod:`legcal.descriptions.firmware`.
"""
