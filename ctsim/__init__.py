"""Simulate polychromatic cone-beam CT scans of voxel phantoms with analytic metal inserts."""
