"""Lines, frames and directions: pure NumPy, knows no robot and no camera."""
