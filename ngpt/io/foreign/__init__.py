"""Reads images in formats other than OpenEXR: PFM, Radiance HDR, PNG, TIFF and JPEG."""
