"""The mechanics and the time loop of one rank, and what ranks exchange."""
