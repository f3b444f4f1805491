"""The page of everything evaluated, and the sections it is made of."""
