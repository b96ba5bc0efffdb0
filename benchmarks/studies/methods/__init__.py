"""`run-benchmark DATA RESULTS`: reconstruction methods over a dataset, scored and timed."""
