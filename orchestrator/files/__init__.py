"""Files of a sweep: writing, reading, checking, and provenance."""
