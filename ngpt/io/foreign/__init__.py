"""Images of other formats than OpenEXR: PFM, Radiance HDR, PNG, TIFF, JPEG. ``files`` reads them all."""
