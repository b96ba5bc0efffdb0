"""How wrong a volume is: metrics, and the protocols under which they are taken."""
