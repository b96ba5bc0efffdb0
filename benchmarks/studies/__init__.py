"""What is measured: one folder or module for each command of `run-benchmark`."""
