"""Volumes of other programs: CT volumes read from, and volumes written to, the formats of medical imaging."""
