"""The photon map: its light paths, the radius of gathering, and the search for photons."""
