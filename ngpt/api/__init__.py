"""Functions for images in memory, which come from and return to NumPy, PyTorch, Dr.Jit or Mitsuba."""
