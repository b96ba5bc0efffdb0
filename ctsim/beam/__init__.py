"""What leaves the source: spectrum, focal spot, dose, and the energies that stand for a spectrum."""
