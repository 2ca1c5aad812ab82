"""Results of a run: displacement fields, errors, reports and pictures."""
