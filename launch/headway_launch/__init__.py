"""The command line and the session behind it: names are resolved to environments and algorithms only here."""
