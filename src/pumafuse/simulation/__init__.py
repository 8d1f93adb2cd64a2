"""Simulated recorded runs, with the true motion as their reference."""
