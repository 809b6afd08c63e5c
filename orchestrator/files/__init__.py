"""Files of a sweep: writing, reading and checking."""
