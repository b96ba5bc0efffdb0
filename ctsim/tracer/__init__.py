"""Path lengths of all materials along rays, through voxels and analytic solids."""
