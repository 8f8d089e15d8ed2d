"""The gradient-domain path tracer: one base path and four offset paths in one kernel."""
