"""Section 4.2: how well repeated images of one pose agree on where the legs are."""
