"""What the classical methods share: observations, factorisations, solvers, symmetries."""
