"""What a method returns, how it is scored, and what training and use share."""
