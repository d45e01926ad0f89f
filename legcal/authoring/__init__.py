"""Models without writing URDF: from a table or a few dimensions to the files of a mechanism."""
