"""Photons gathered in media: at points, from beams and from planes, and the gradients of these and of rays."""
