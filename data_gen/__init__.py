"""data_gen: renders gradient stacks with Mitsuba 3. The only package of ngpt that imports mitsuba and drjit."""
