"""Kalman-filter fusion of a robot arm's commands with the readings of an external sensor."""
