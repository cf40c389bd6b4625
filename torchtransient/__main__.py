"""`python -m torchtransient`: the command line."""

from torchtransient.cli.main import main

if __name__ == "__main__":
    main(prog_name="torchtransient")
