"""Before a run: the contents of a deck, and the steps, time and memory of its run."""
