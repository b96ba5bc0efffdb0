"""Photons and electrons in a scintillator's slab: a fast kernel and its reference."""
