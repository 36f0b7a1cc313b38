"""What `benchmarks.peers` runs: scenes, references in float64, and one module for each contender, named by_NAME."""
