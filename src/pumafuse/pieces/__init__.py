"""Runs that are too long for memory: read, fused and written piece by piece."""
