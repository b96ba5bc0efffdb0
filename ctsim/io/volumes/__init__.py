"""CT volumes in the formats of medical imaging, read and written: one module a format, and their table (`formats`)."""
