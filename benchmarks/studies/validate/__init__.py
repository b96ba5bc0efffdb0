"""`run-benchmark validate`: the physics of ctsim against published tables, closed forms and long Monte Carlo runs."""
