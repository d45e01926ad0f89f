"""Photographs of solids: rays, surfaces, light, lens and sensor, seeded to the last bit."""
