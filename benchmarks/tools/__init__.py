"""Scripts of the developers; not part of an installed ctsim."""
