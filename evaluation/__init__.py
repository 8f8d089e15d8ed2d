"""Evaluation: every method on the same scenes, by the same clock. Uses ngpt and data_gen, which do not know it."""
