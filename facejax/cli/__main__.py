"""Run the `facejax` command as `python -m facejax.cli`."""

from facejax.cli.main import main

if __name__ == "__main__":
    main()
