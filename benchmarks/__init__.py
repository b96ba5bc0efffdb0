"""Run methods over datasets and tabulate how wrong and how slow they are."""
