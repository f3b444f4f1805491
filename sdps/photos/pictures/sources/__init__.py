"""What people hand in instead of a folder of photographs: archives, films, and folders of several poses."""
