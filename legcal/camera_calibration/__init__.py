"""A camera calibrated from photographs of a flat board."""
