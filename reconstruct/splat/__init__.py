"""Reconstruction by Gaussian splats with a polychromatic response."""
