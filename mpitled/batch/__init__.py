"""Commands that run many decks: sweep, study, stability."""
