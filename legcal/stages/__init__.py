"""Sections 3.2 to 3.5: the four steps, one file a step."""
