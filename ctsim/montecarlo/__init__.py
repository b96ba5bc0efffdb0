"""Photon Monte Carlo: scatter images and absorbed energy in the phantoms that the simulator projects."""
