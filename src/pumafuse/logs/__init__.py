"""Recorded runs: reading logs, their clocks and their frames."""
