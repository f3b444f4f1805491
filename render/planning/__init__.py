"""Everything decided before the first pixel: scenes, views, lights, disk and time."""
