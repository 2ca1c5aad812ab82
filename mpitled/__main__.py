"""`python -m mpitled` is the command."""

from mpitled.cli import main

main()
