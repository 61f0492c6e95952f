"""`python -m headway_launch` is `headway`."""

from headway_launch.command_line import main

if __name__ == "__main__":
    main()
