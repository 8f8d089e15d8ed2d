"""The photon map: its light paths, its radius, and the search for photons."""
