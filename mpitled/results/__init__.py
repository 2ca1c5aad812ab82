"""What is made of a result: fields, errors, reports, pictures."""
