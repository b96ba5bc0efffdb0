"""`run-benchmark paper-tables`: the tables of the published splat method."""
