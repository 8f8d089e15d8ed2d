"""What makes a network: data sets, examples, losses, the trainer."""
