"""Files: outputs that appear complete or not at all, YAML by schema, tables in CSV, quantities.

All reading and writing goes through this package, so that all files are refused in the same words:
paths and bytes in, checked documents (:class:`FileSchema`), columns (:class:`Table`) and numbers
with units out. It knows rigid motions (:class:`MotionEntry`), but neither machines nor cameras.
"""
