"""Refinement where each image is lit from all around: no lamps, only the low-order light of each image."""
