"""Spectra, wavelength by wavelength: glass that disperses, and differences between neighbouring wavelengths."""
