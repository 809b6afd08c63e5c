"""The networks of policies and critics, their parameters in one flat vector, and Adam on it."""
