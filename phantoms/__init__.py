"""Scene recipes: procedural bodies, inserts, and the scanners that scan them."""
