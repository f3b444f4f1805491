"""Scripts behind the figures of docs/studies; each says in its first lines how it is run."""
