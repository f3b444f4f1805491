"""Networks, one file each; `registry.create` builds them by name."""
