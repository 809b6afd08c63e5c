"""One trial: its specification, the training loop, saved policies and videos."""
