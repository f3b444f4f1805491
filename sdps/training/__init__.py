"""Training: configuration, stages, the loop, its optimiser, logs and model cards."""
