"""The report of a sweep: figures, tables, and the pages that hold them."""
