"""Files: outputs that appear complete or not at all, YAML by schema, tables in CSV, quantities.

What any room reads or writes goes through here, so that every file is refused in the same words:
paths and bytes in, checked documents (:class:`FileSchema`), columns (:class:`Table`) and numbers
with units out. Only rotations are known (:class:`MotionEntry`), no machine and no camera.
"""
