"""Doors for arrays: images in and out, of NumPy, PyTorch, Dr.Jit or Mitsuba."""
