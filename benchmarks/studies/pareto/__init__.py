"""`run-benchmark pareto`: run time against error."""
