"""Kernels of the reconstruction methods."""
