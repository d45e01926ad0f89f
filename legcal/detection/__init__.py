"""Section 3.1: outlines found in photographs, guided by where the legs should be."""
