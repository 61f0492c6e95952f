"""Small environments with known best return, for tests, benchmarks and first steps."""
