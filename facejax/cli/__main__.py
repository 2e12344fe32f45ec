"""`python -m facejax.cli`: the `facejax` command."""

from facejax.cli.main import main

if __name__ == "__main__":
    main()
