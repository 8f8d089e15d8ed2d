"""Every sampler and method on the same scenes with the same clock; tables, plots and a report."""
