"""Scenes in the memory of the device that trains, and samples made of them there."""
