"""`python -m drakerock` is the command `drakerock`."""

from drakerock.cli import main

if __name__ == "__main__":
    main()
