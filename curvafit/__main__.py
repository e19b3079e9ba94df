"""python -m curvafit: the command line."""

from curvafit.cli import main

if __name__ == "__main__":
    main()
