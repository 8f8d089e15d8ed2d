"""Denoisers that use no gradients, as methods: OIDN, NFOR, non-local means."""
