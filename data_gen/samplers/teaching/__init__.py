"""Short versions of ``gpt``, to be read before the fast one."""
