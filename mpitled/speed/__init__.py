"""How fast and how large a run is: measured, counted and predicted."""
