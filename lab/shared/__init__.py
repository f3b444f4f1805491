"""What benchmarks and studies share."""
