"""`run-benchmark skipping`: what is left out, the time it saves, and what it changes."""
