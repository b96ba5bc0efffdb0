"""Splats that gradient descent moves, reshapes, splits and removes, as the published methods do."""
