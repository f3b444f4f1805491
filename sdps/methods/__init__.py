"""Methods, learned and classical, behind one interface: choosing, loading, running."""
