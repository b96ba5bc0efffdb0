"""The bodies that recipes draw, one module each or for a few of a kind."""
