"""MLflow: what of a sweep is shown there, and how it is kept up to date."""
