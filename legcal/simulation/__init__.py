"""Section 4.3: simulated measurements. No module of the method imports this package."""
