"""`run-benchmark stress`: numerically hard cases, each with its expected outcome."""
