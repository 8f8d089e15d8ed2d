"""Denoisers that use no gradients: OIDN, NFOR, and the diffusion of light that gradients exclude."""
