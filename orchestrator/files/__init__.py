"""The files of a sweep: writing, reading, checking, and where their contents come from."""
