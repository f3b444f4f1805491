"""Methods without learning, one file each; all return a `sdps.core.estimate.Estimate`."""
