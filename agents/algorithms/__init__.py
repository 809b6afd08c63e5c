"""The published algorithms, one file each."""
