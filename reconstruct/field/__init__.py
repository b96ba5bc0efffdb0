"""Neural fields: attenuation as a small network of a hash encoding, fitted to one scan alone."""
