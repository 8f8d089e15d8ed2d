"""The photon map: light traced from the lamps, kept, and found again."""
