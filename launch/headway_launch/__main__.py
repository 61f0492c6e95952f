"""Entry point of `python -m headway_launch`, equivalent to `headway`."""

from headway_launch.commands.main import main

if __name__ == "__main__":
    main()
