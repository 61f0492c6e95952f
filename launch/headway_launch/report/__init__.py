"""`headway report`: a study as one page and its parts as files."""
