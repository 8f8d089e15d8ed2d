"""Reconstructions of section 5 of the survey that are no method of ours, and all of them side by side."""
