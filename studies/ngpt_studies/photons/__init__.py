"""Photons that gain nothing over ``ppm``, ``bre`` and ``vcm``: in balls, beams and planes, and their gradients."""
