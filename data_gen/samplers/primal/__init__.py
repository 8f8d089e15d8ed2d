"""The scene's own integrator, without gradients."""
