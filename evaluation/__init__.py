"""Evaluation: every method on the same scenes, with the same clock. Above ngpt and data_gen, which know nothing of it."""
