"""Arguments of the command line for launches in tests."""

INLINE = ("--executor", "inline", "--no-mlflow", "--no-figures")  # in this process, with nothing else
