"""Section 4.1: the dataset folder, read and validated, and its rows in a fixed order."""
