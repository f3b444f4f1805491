"""Real benchmarks by folder: one module a benchmark, each turning files into objects to evaluate."""
