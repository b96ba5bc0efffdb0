"""What the panel makes of photons: response, blur, lag, noise, ADC."""
