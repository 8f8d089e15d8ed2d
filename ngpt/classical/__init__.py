"""Reconstructions from gradients without a network: screened Poisson and control variates."""
