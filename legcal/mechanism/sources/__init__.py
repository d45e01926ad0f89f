"""Reading a mechanism from whatever format it is written in, as one tree with closures."""
