"""Fusion: one Kalman filter per axis, fed with the events of a run in their total order."""
