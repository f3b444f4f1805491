"""Work on the workers of a Dask cluster: `--cluster` of the commands."""
