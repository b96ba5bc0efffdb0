"""`run-benchmark peers`: speed and error next to other libraries."""
