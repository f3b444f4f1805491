"""The paper's figures on MERL-Test, one module each: `make(bench)` evaluates and returns tables, charts, numbers."""
