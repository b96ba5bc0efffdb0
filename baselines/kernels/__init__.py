"""Kernels of the baselines on flat arrays: one reference and one fast twin for every operator."""
