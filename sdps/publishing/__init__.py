"""What goes with weights to other people: the model card and learning curves."""
