"""Measured scans in the layouts of other programs: one module a layout, and their table (`formats`)."""
