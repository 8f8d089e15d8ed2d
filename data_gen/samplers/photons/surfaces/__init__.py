"""Photons gathered on surfaces."""
