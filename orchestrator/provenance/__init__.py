"""What produced a result: versions and machine, digests of the code, and recrl's own files."""
