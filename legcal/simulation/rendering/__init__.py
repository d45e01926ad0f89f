"""The renderer: photographs of solids with known edges, light, lens and sensor."""
