"""Short versions of ``gpt``, for readers who want to understand it before they read the fast version."""
