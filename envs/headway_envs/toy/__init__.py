"""Small environments whose best return is known: for tests, benchmarks and first steps."""
