"""Recorded runs: what was commanded and what the sensors said, as it stands in the log."""
