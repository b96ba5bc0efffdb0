"""Metal artefact reduction methods to compare with."""
