"""Section 3.1: the camera, its files and images, and cylinders in its view (eqs 1-5)."""
