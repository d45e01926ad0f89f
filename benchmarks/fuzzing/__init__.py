"""Mutated inputs of every reader, run in child processes with limits."""
