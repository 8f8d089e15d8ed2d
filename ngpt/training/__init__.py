"""Training of networks: data sets, examples, losses, the trainer."""
