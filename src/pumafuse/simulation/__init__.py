"""Recorded runs on demand, with the truth in them."""
