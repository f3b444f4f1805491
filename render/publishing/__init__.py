"""What goes with data to other people: dataset card, Croissant metadata, Mitsuba scene files."""
