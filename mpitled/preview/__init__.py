"""What a run will do, before it does: what a deck holds, its steps, time and memory."""
