"""Commands that run many decks: sweeps and studies."""
