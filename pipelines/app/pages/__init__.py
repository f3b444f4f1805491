"""The rooms of the page: what the server answers, and what the worker does, one pair of modules each."""
