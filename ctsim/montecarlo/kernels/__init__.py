"""Compiled code of the photon Monte Carlo, and its float64 references."""
