"""`python -m invariode.cli` is the command `invariode`."""

from . import main

if __name__ == "__main__":
    main()
