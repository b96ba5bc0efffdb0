"""Bodies of patients with several implants of several metals."""
