"""What photons give to the gradients: their copies for the neighbours' camera paths."""
