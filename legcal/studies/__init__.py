"""Monte Carlo studies: what is claimed, measured on simulated machines whose truth is known."""
