"""Photon maps that know the light paths of their photons: their predecessors, what rays met, and their edges."""
