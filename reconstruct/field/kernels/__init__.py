"""Sparse sums of the hash encoding."""
