"""What every folder stands on: errors, files, YAML, seeds, pictures and tables; neither mitsuba nor torch."""
