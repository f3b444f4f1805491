"""What a series of pictures, given as arrays, says about movement, colour of the light and distance of the lamps."""
