"""Learned rows: small networks on FDK, LIMAR, NMAR and the metal mask, with their weights, and how they are trained."""
