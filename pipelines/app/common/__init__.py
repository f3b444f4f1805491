"""What all pages share: sessions, uploads, the queue of jobs and its worker."""
