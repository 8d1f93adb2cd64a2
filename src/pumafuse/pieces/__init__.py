"""Runs that are too long for the memory: read, fused and written a piece at a time."""
