"""Images in formats other than OpenEXR: PFM, Radiance HDR, PNG, TIFF, JPEG. ``files`` reads them all."""
