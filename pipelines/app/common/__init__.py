"""What all rooms share: visitors, uploads, the queue and its worker."""
