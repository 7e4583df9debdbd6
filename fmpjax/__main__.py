"""`python -m fmpjax` is `fmpjax`."""

from fmpjax.cli import main

if __name__ == "__main__":
    main()
