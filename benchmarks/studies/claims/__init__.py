"""What is claimed of methods, checked by records of them."""
