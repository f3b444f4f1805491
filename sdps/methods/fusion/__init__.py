"""One answer from two witnesses: the network that has seen many objects, and the model that explains this one."""
