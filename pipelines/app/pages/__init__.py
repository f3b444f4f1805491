"""The pages: for each, a module of what the server answers and one of what the worker does."""
