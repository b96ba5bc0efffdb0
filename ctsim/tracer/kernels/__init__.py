"""Kernels on flat arrays: one reference and one fast twin for every operator."""
