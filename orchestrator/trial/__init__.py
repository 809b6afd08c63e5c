"""One trial: the training loop, its attempts, saved policies and videos (its specification: ``spec.py``)."""
