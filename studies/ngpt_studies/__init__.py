"""Samplers and methods that were measured and lost: kept for comparison, on the entry points of ngpt alone."""
