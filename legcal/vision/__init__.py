"""Section 3.1: from pixels to the axes of cylinders."""
