"""Configuration records, and their construction from mappings."""
