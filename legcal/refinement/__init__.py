"""Beyond the paper: one fit of everything at once, in the image."""
