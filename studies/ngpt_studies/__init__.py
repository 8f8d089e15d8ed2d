"""Samplers and methods that were measured and lost: kept for comparison. They use only the entry points of ngpt."""
