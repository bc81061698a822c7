"""`python -m kinefit` is the command line."""

from kinefit.cli import main

if __name__ == "__main__":
    main()
