"""`python -m headway_launch` is `headway`."""

from headway_launch.commands.main import main

if __name__ == "__main__":
    main()
