"""Reference pages of the documentation, written from the types that they describe.

python -m ctsim.benchmarks.tools.reference docs/reference
"""
