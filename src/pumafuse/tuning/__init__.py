"""Tuning: noise, delays, plants, gains and latencies of recorded runs by maximum likelihood."""
