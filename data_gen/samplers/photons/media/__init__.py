"""Photons gathered in media: at points, along rays, from beams and planes."""
