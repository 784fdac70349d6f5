"""`python -m invariode` is the command `invariode`."""

from .cli import main

if __name__ == "__main__":
    main()
