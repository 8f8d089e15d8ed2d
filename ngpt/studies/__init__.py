"""Reconstructions that were measured and lost: kept to be compared with, not to be used."""
